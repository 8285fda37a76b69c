"""Demonstrations and their file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from torchrl_her import save_checkpoint
from torchrl_her.demonstrations import Demonstrations
from torchrl_her.trainers import load_checkpoint

from ..her_data import make_batch
from .walks import walks


def tags(own: Demonstrations) -> list[float]:
    return own.rows["observation"][:, 0].tolist()


# Episodes of a rollout


def test_a_rollout_s_episodes_come_environment_after_environment() -> None:
    own = Demonstrations.from_rollout(make_batch([[2, 3], [4, 1]]))
    assert own.lengths.tolist() == [2, 3, 4, 1]
    assert tags(own) == [0, 1, 100, 101, 102, 1000, 1001, 1002, 1003, 1100]
    assert own.begins.tolist() == [0, 2, 5, 9]
    assert own.episode.tolist() == [0, 0, 1, 1, 1, 2, 2, 2, 2, 3]
    assert "state" not in own.rows.keys()
    assert ("collector", "traj_ids") not in own.rows.keys(True)


def test_only_the_first_ones_with_their_states() -> None:
    batch = make_batch([[2, 3], [4, 1]])
    place = torch.arange(10).view(2, 5, 1)
    own = Demonstrations.from_rollout(batch, first=True, states={"place": place})
    assert own.lengths.tolist() == [2, 4]
    assert tags(own) == [0, 1, 1000, 1001, 1002, 1003]
    assert own.states is not None
    assert own.states["place"].flatten().tolist() == [0, 1, 5, 6, 7, 8]


def test_a_rollout_may_be_of_one_environment_without_a_batch() -> None:
    place = torch.arange(5).unsqueeze(-1)
    own = Demonstrations.from_rollout(make_batch([[2, 3]])[0], first=True, states={"place": place})
    assert tags(own) == [0, 1]
    assert own.states is not None
    assert own.states["place"].flatten().tolist() == [0, 1]


def test_an_episode_that_is_open_at_the_end_is_truncated_there() -> None:
    batch = make_batch([[9]], steps=4)
    own = Demonstrations.from_rollout(batch)
    assert own.lengths.tolist() == [4]
    assert own.rows["next", "truncated"].flatten().tolist() == [False, False, False, True]
    assert not batch["next", "done"].any()  # which was left as it was


def test_which_have_achieved_their_goal() -> None:
    own = walks(3, 2, 4, goal=102.0)
    assert own.achieved.tolist() == [False, True, False]
    rewarded = walks(3, 2, 4, goal=102.0, achieved_reward=-1.0)
    assert rewarded.achieved.tolist() == [True] * 3


# Some of them


def test_episodes_are_chosen_with_their_states() -> None:
    own = walks(3, 2, 4).select([2, 0])
    assert tags(own) == [200, 201, 202, 203, 0, 1, 2]
    assert own.states is not None
    assert own.states["place"].flatten().tolist() == tags(own)
    assert own.lengths.tolist() == [4, 3]
    assert tags(walks(3, 2, 4).first(2)) == [0, 1, 2, 100, 101]


def test_episodes_are_chosen_by_a_mask() -> None:
    own = walks(3, 2, 4, goal=102.0)
    assert tags(own.select(own.achieved)) == [100, 101]
    assert tags(own.select(~own.achieved)) == [0, 1, 2, 200, 201, 202, 203]


@pytest.mark.parametrize("count", [0, 4])
def test_more_than_there_are_cannot_be_had(count: int) -> None:
    with pytest.raises(ValueError, match=f"there are 3 demonstrations of walk, {count} were asked for"):
        walks(3, 2, 4).first(count)


def test_several_are_joined() -> None:
    both = Demonstrations.join([walks(2), walks(1, 3)])
    assert tags(both) == [0, 1, 0, 100, 101, 102]
    assert both.states is not None
    assert both.states["goal"].flatten().tolist() == [2, 2, 1, 103, 103, 103]


def test_numbers_take_another_type_and_states_stay() -> None:
    own = walks(3).to(torch.float64)
    assert own.rows["action"].dtype == own.rows["next", "reward"].dtype == torch.float64
    assert own.rows["next", "done"].dtype == torch.bool
    assert own.states is not None
    assert own.states["goal"].dtype == torch.float32


def test_the_digest_tells_episodes_apart() -> None:
    assert walks(3, 2).digest == walks(3, 2).digest
    other = walks(3, 2)
    other.rows["action"][4] += 1e-6
    assert len({walks(3, 2).digest, walks(2, 3).digest, other.digest, walks(3, 2, states=False).digest}) == 4


# What fits together


def changed(**changes: Any) -> dict[str, Any]:
    own = walks(3, 2)
    return {"rows": own.rows, "lengths": own.lengths, "states": own.states} | changes


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"lengths": torch.tensor([3, 3])}, r"rows must be \[6\], the sum of all lengths, got \[5\]"),
        ({"lengths": torch.tensor([2, 3])}, "the last transition of each demonstration must be done, and no"),
        ({"lengths": torch.tensor([5, 0])}, r"lengths \[E\] of at least 1, got \[5, 0\]"),
        ({"lengths": torch.empty(0, dtype=torch.int64)}, r"lengths \[E\] of at least 1, got \[\]"),
        ({"rows": walks(3, 2).rows.exclude("action")}, "demonstrations need the entry 'action', got"),
        (
            {"rows": walks(3, 2).rows.exclude(("next", "reward"))},
            r"demonstrations need the entry \('next', 'reward'\)",
        ),
        ({"states": {"place": torch.zeros(4, 1)}}, r"states must have 5 rows, got \[4, 1\] of 'place'"),
    ],
)
def test_what_does_not_fit_together(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Demonstrations(**changed(**changes))


def test_a_rollout_without_ends_is_refused() -> None:
    with pytest.raises(ValueError, match=r"demonstrations need the entry \('next', 'done'\), got"):
        Demonstrations.from_rollout(make_batch([[3]]).exclude(("next", "done")))


# The file


def test_what_is_read_is_what_was_written(tmp_path: Path) -> None:
    own = walks(3, 2, made_by={"policy": "a walker", "seed": 3}, achieved_reward=0.5)
    own.save(tmp_path / "walks.pt")
    read = Demonstrations.load(tmp_path / "walks.pt")
    assert (read.digest, read.task, read.made_by) == (own.digest, "walk", {"policy": "a walker", "seed": 3})
    assert read.achieved_reward == 0.5
    assert (read.rows == own.rows).all()
    assert set(load_checkpoint(tmp_path / "walks.pt")) >= {"rows", "states", "lengths", "task"}


def test_a_file_that_is_there_is_replaced_only_by_force(tmp_path: Path) -> None:
    path = tmp_path / "walks.pt"
    walks(3).save(path)
    with pytest.raises(ValueError, match=r"walks.pt exists already: choose another name, or --force"):
        walks(2).save(path)
    assert Demonstrations.load(path).lengths.tolist() == [3]
    walks(2).save(path, force=True)
    assert Demonstrations.load(path).lengths.tolist() == [2]


def test_a_damaged_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "walks.pt"
    walks(3).save(path)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    with pytest.raises(ValueError, match=r"demonstrations cannot be read: .*walks.pt is damaged"):
        Demonstrations.load(path)
    path.write_bytes(b"something else")
    with pytest.raises(ValueError, match=r"demonstrations cannot be read: .*is not a checkpoint"):
        Demonstrations.load(path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"kind": "demonstrations 99"}, "holds no demonstrations: `torchrl-her record` writes some"),
        ({"lengths": torch.tensor([1, 4])}, "do not fit together: the last transition"),
        ({"lengths": 3}, "do not fit together"),
        ({"rows": {"observation": torch.zeros(5, 1)}}, "do not fit together: demonstrations need the entry"),
        ({"rows": None}, "do not fit together"),
        ({"states": {"place": torch.zeros(2)}}, r"do not fit together: states must have 5 rows"),
    ],
)
def test_a_file_of_something_else_is_refused(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    walks(3, 2).save(tmp_path / "walks.pt")
    save_checkpoint({**load_checkpoint(tmp_path / "walks.pt"), **changes}, tmp_path / "other.pt")
    with pytest.raises(ValueError, match=message):
        Demonstrations.load(tmp_path / "other.pt")


def test_a_file_that_lacks_something_is_refused(tmp_path: Path) -> None:
    walks(3, 2).save(tmp_path / "walks.pt")
    state = load_checkpoint(tmp_path / "walks.pt")
    del state["made_by"]
    save_checkpoint(state, tmp_path / "other.pt")
    with pytest.raises(ValueError, match="do not fit together: 'made_by'"):
        Demonstrations.load(tmp_path / "other.pt")


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        Demonstrations.load(tmp_path / "none.pt")


@pytest.mark.parametrize("key", ["observation", "action", ("next", "achieved_goal"), ("next", "reward")])
def test_demonstrations_must_be_finite(key: str | tuple[str, str]) -> None:
    batch = make_batch([[2]])
    batch[key][0, 1] = float("nan")
    with pytest.raises(ValueError, match=r"of demonstrations must be finite, got nan in it"):
        Demonstrations.from_rollout(batch)
