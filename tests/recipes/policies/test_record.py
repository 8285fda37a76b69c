"""Recording demonstrations."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import torch

from torchrl_her.demonstrations import Demonstrations
from torchrl_her_envs import make_env
from torchrl_her_recipes import cli, record_demonstrations
from torchrl_her_recipes.policies import record

from ..small import Refused


def test_the_scripted_controller_s_episodes_are_written(tmp_path: Path) -> None:
    path = tmp_path / "demos.pt"
    recorded = record_demonstrations("hand_wall_v1", path, episodes=7, seed=3)
    own = Demonstrations.load(path)
    assert own.digest == recorded.demonstrations.digest
    assert len(own) == 7
    assert own.achieved.all()
    assert own.task == "hand_wall_v1"
    assert own.made_by == own.made_by | {
        "policy": "the scripted controller",
        "seed": 3,
        "played": recorded.played,
        "achieved": 7,
    }
    assert set(own.states) == set(make_env("hand_wall_v1").world_state_dict()) - {"key", "step", "episode"}


def test_a_state_is_what_its_row_shows(tmp_path: Path) -> None:
    own = record_demonstrations("robot_v1", tmp_path / "demos.pt", episodes=2).demonstrations
    env = make_env("robot_v1", num_envs=len(own.rows))
    env.reset()
    shown = env.start_at(own.states, torch.arange(len(own.rows)))
    for key in ("observation", "achieved_goal", "desired_goal"):
        assert torch.equal(shown[key], own.rows[key]), key


def test_seeds_repeat_and_differ(tmp_path: Path) -> None:
    paths = [tmp_path / f"{place}.pt" for place in range(3)]
    for path, seed in zip(paths, (1, 1, 2), strict=True):
        record_demonstrations("hand_v0", path, episodes=3, seed=seed)
    first, again, other = [Demonstrations.load(path).digest for path in paths]
    assert first == again != other


def test_it_plays_until_there_are_enough_that_succeed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(record, "_AT_ONCE", 6)
    recorded = record_demonstrations("hand_wall_v1", tmp_path / "demos.pt", episodes=8, policy="hand_v1")
    assert len(recorded.demonstrations) == recorded.achieved == 8
    assert recorded.played > 8
    assert recorded.demonstrations.achieved.all()
    assert recorded.demonstrations.made_by["policy"] == "hand_v1, a policy of hand_v1"


def test_all_of_them(tmp_path: Path) -> None:
    recorded = record_demonstrations(
        "hand_wall_v1", tmp_path / "demos.pt", episodes=8, policy="hand_v1", keep_all=True
    )
    own = recorded.demonstrations.achieved
    assert (len(own), recorded.played) == (8, 8)
    assert 0 < int(own.sum()) == recorded.achieved < 8


def test_environments_of_gymnasium_have_no_states(tmp_path: Path) -> None:
    task = "gym:torchrl_her/HandThrow-v1"
    recorded = record_demonstrations(task, tmp_path / "demos.pt", episodes=2, policy="hand_v1", keep_all=True)
    assert recorded.demonstrations.states is None
    assert recorded.demonstrations.task == task


@pytest.mark.parametrize(
    ("task", "options", "message"),
    [
        ("bit_flip", {}, "bit_flip has no scripted controller: give another --policy"),
        ("bit_flip", {"policy": "hand_v1"}, "a policy of hand_v1 cannot play bit_flip"),
        ("hand_v9", {}, "unknown task 'hand_v9'; did you mean hand_v0"),
        ("hand_v1", {"policy": "nobody"}, "nobody is neither the folder of a run, nor the file"),
        ("hand_v1", {"policy": "robot_v1"}, "a policy of robot_v1 cannot play hand_v1: the policy has"),
        ("hand_v1", {"episodes": 0}, "episodes must be at least 1, got 0"),
        (
            "hand_wall_v1",
            {"policy": "hand_v0", "episodes": 2},
            r"only \d of 20 episodes of hand_wall_v1 by hand_v0, a policy of hand_v0 achieved their goal",
        ),
    ],
)
def test_what_cannot_be_recorded(task: str, options: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message):
        record_demonstrations(task, tmp_path / "demos.pt", **options)
    assert not (tmp_path / "demos.pt").exists()


# The command


def test_the_command_says_how_many_of_how_many(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], refused: Refused
) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.main(["record", "hand_v0", "--episodes", "3"]) == 0
    out = capsys.readouterr().out
    assert re.fullmatch(
        r"3 of \d episodes achieved their goal; 3 of them with \d+ transitions are in hand_v0_demos.pt\n", out
    )
    assert len(Demonstrations.load("hand_v0_demos.pt")) == 3
    assert refused("record", "hand_v0", "--episodes", "3") == (
        "torchrl-her: hand_v0_demos.pt exists already: choose another name, or --force (force=True) to "
        "replace it\n"
    )
    assert cli.main(["record", "hand_v0", "--episodes", "2", "--seed", "1", "--force"]) == 0
    assert len(Demonstrations.load("hand_v0_demos.pt")) == 2
