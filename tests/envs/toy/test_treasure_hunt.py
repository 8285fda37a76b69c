"""The treasure hunt step by step, and what hindsight makes of the ends of the line.

Hunts go in steps of 10 units unless said otherwise, so that place k of 0 to 10 is shown as k / 5 - 1.
"""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from torchrl_her_envs import ToyEnv, TreasureHunt

from .toy_envs import act, put, relabelled


def test_the_pirate_walks_to_the_treasure() -> None:
    env = TreasureHunt(10)
    env.reset()
    put(env, place=[3], goal=[1])
    steps = [act(env, action) for action in (1, 0, 0, 0)]
    assert [round(after["observation"].item(), 6) for after in steps] == [-0.2, -0.4, -0.6, -0.8]
    assert [after["reward"].item() for after in steps] == [-1, -1, -1, 0]
    assert [after["terminated"].item() for after in steps] == [False, False, False, True]
    assert not any(after["truncated"].item() for after in steps)


@pytest.mark.parametrize(("place", "action"), [(0, 0), (10, 1)])
def test_the_pirate_stays_at_the_ends(place: int, action: int) -> None:
    env = TreasureHunt(10)
    env.reset()
    put(env, place=[place], goal=[5])
    after = [act(env, action) for _ in range(10)]
    assert {one["observation"].item() for one in after} == {place / 5 - 1}
    assert [one["truncated"].item() for one in after] == [False] * 9 + [True]
    assert not any(one["terminated"].item() for one in after)


@pytest.mark.parametrize("step", [1, 4, 100])
def test_the_way_to_the_treasure_is_never_too_long(step: int) -> None:
    env = TreasureHunt(step, num_envs=300, seed=1)
    now = env.reset()
    assert env.max_steps == 100 // step
    found, towards = torch.zeros(300, dtype=torch.bool), now["desired_goal"] > now["observation"]
    for _ in range(env.max_steps):
        found |= act(env, *towards.squeeze(-1).long())["terminated"].squeeze(-1)
    assert found.all()


def test_pirate_and_treasure_are_anywhere_but_at_the_same_place() -> None:
    shown = TreasureHunt(50, num_envs=6000).reset()
    start, goal = ((shown[key].squeeze(-1) + 1).long() for key in ("observation", "desired_goal"))
    pairs = (3 * start + goal).bincount(minlength=9).view(3, 3)
    assert pairs.diagonal().tolist() == [0, 0, 0]
    others = pairs[~torch.eye(3, dtype=torch.bool)]
    assert ((others - 1000).abs() < 160).all()  # five standard deviations


def test_the_whole_line_is_used() -> None:
    shown = TreasureHunt(num_envs=5000).reset()
    for key in ("observation", "desired_goal"):
        places = shown[key].unique()
        assert len(places) == 101
        assert (places[0].item(), places[-1].item()) == (-1.0, 1.0)


def test_hindsight_praises_walking_against_the_end_of_the_line() -> None:
    env = TreasureHunt(10)
    now = env.reset()
    put(env, place=[0], goal=[5])
    now.update({"observation": [[-1.0]], "achieved_goal": [[-1.0]], "desired_goal": [[0.0]]})
    rows = []
    for _ in range(10):
        row, now = env.step_and_maybe_reset(now.set("action", torch.tensor([0])))
        rows.append(row)
    steps = torch.stack(rows, 1)
    assert steps["next", "done"].flatten().tolist() == [False] * 9 + [True]
    _, virtual = relabelled(env, steps)
    assert (virtual["next", "reward"] == 0).all()
    assert len(relabelled(env, steps, filter_achieved=True)[1]) == 0


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: TreasureHunt(3), "step must divide 100, so be one of 1, 2, 4, 5, .*, 100; got 3"),
        (lambda: TreasureHunt(0), "step must be a whole number from 1 to 100, got 0"),
    ],
)
def test_what_cannot_be_made(make: Callable[[], ToyEnv], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()
