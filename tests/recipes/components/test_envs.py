"""Recipes on small worlds, with other learners, and with curricula from YAML."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from torchrl.objectives import DQNLoss, SACLoss, TD3Loss, TQCLoss

from torchrl_her.goals import GoalHistogram
from torchrl_her.modules import DecayingEpsilonGreedy
from torchrl_her_envs import BitFlip, Chain, TreasureHunt, goal_env
from torchrl_her_recipes import build, resume, run
from torchrl_her_recipes.cli import main

from ..small import assert_same_runs, overrides, small

FINE = {"name": "fine", "observation": [0], "achieved_goal": [0], "desired_goal": [1]}


@pytest.mark.parametrize(
    ("task", "options", "algo", "kind"),
    [
        ("bit_flip", {"bits": 5, "useless_action": True}, "filtered_her", BitFlip),
        ("treasure_hunt", {"step": 10}, "no_hindsight", TreasureHunt),
        ("chain", {"length": 6, "forward_probability": 0.9}, "her", Chain),
    ],
)
def test_small_worlds_train_by_name(task: str, options: dict[str, Any], algo: str, kind: type) -> None:
    components = build(small(task=task, options=options, algo=algo, num_runs=2))
    assert isinstance(goal_env(components.env), kind)
    assert isinstance(components.loss, DQNLoss)
    rows = run(components, progress=False).rows
    assert len(rows) == 4
    assert all(-50.0 <= row["q"] <= 10.0 and row["loss"] > 0 for row in rows)


def test_a_run_of_dqn_equals_the_single_run_with_its_seed() -> None:
    """To rounding: batched products add up in another order."""
    common: dict[str, Any] = {"task": "bit_flip", "options": {"bits": 4}, "algo": "her", "epochs": 1}
    both = run(build(small(**common, num_runs=2, seed=3)), progress=False).rows
    alone = run(build(small(**common, seed=4)), progress=False).rows
    assert both[1]["rows_virtual"] == pytest.approx(alone[0]["rows_virtual"], rel=0.05)
    assert both[1]["loss"] == pytest.approx(alone[0]["loss"], rel=0.2)


def test_bit_flip_of_few_bits_is_solved() -> None:
    recipe = small(task="bit_flip", options={"bits": 5}, algo="her", epochs=3, frames_per_update=4)
    components = build(recipe.replace(episodes=50, learning_rate=3e-3))
    assert isinstance(components.exploration, DecayingEpsilonGreedy)
    assert run(components, progress=False).success >= 0.9


def test_small_worlds_go_on_from_checkpoints_bit_for_bit(tmp_path: Path) -> None:
    options: dict[str, Any] = {"task": "treasure_hunt", "options": {"step": 20}, "algo": "filtered_her"}
    run(build(small(**options, epochs=3)), tmp_path / "whole", progress=False)
    run(build(small(**options, epochs=2)), tmp_path / "half", progress=False)
    resume(tmp_path / "half", options={"epochs": 3}, progress=False)
    config = yaml.safe_load((tmp_path / "half" / "config.yaml").read_text())
    assert config["task"]["options"] == {"step": 20}
    assert_same_runs(tmp_path / "whole", tmp_path / "half")


def test_goals_on_a_line_may_be_preferred() -> None:
    components = build(small(task="treasure_hunt", algo="her_ibs"))
    assert isinstance(components.buffer.writer.weights, GoalHistogram)
    assert components.goal_target.shape == (20,)
    assert run(components, progress=False).rows[-1]["kl"] >= 0


@pytest.mark.parametrize(
    ("learner", "loss"), [("td3", TD3Loss), ("sac", SACLoss), ("redq", SACLoss), ("tqc", TQCLoss)]
)
def test_other_learners_train_by_name(learner: str, loss: type, tmp_path: Path) -> None:
    components = build(small(algo="filtered_her", learner=learner, epochs=1))
    assert isinstance(components.loss, loss)
    before = torch.cat([p.detach().flatten().clone() for p in components.actor.parameters()])
    rows = run(components, tmp_path / "run", progress=False).rows
    after = torch.cat([p.detach().flatten() for p in components.actor.parameters()])
    assert not torch.equal(before, after)
    assert rows[-1]["loss_qvalue"] > 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"task": "bit_flip", "learner": "sac"}, "discrete actions: choose dqn"),
        (
            {"task": "hand_v0", "learner": "dqn"},
            "continuous actions: choose ddpg or td3 or sac or redq or tqc",
        ),
        ({"task": "bit_flip", "algo": "cher"}, "bit_flip has no curriculum"),
        ({"task": "treasure_hunt", "algo": "cher", "curriculum": [{"name": "all"}]}, "is no stage"),
        (
            {"task": "treasure_hunt", "algo": "cher", "curriculum": [FINE | {"threshold": 0.1}]},
            "stage 'fine': threshold has no effect in the last stage",
        ),
        (
            {"task": "treasure_hunt", "algo": "cher", "curriculum": [FINE | {"terminates": False}]},
            "stage 'fine': terminates has no effect in the last stage",
        ),
        (
            {"task": "treasure_hunt", "algo": "cher", "curriculum": [FINE | {"desired_goal": [0]}]},
            "stage 'fine': desired_goal must share no index",
        ),
        ({"task": "hand_v1", "algo": "cher", "curriculum": {"stages": {"name": "all"}}}, "must be a list"),
    ],
)
def test_what_cannot_be_is_said_in_a_line(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        build(small(**options))


def test_a_curriculum_comes_from_a_file(tmp_path: Path) -> None:
    """The state of treasure_hunt is [place, goal]: somewhere in the middle first, then where it shall go."""
    stages = [
        {
            "name": "middle",
            "observation": [0],
            "achieved_goal": [0],
            "constant_goal": [0.5],
            "threshold": 0.5,
        },
        FINE,
    ]
    path = tmp_path / "stages.yaml"
    path.write_text(yaml.safe_dump(stages))
    folder = tmp_path / "run"
    options = overrides(task="treasure_hunt", algo="cher", curriculum=path, folder=folder)
    assert main(["train", *options, "options={step: 10}"]) == 0
    config = yaml.safe_load((folder / "config.yaml").read_text())
    assert config["curriculum"]["stages"] == stages


# Gymnasium's environments


@pytest.mark.parametrize("algo", ["her", "filtered_her_ibs", "cher"])
def test_an_environment_of_gymnasium_trains_by_its_id(algo: str, tmp_path: Path) -> None:
    """One of ours, on its way out to gymnasium and in again: its state is [hand, 5 | ball, 2]."""
    stage = {"observation": [0, 1, 2, 3, 4], "achieved_goal": [0, 1], "desired_goal": [5, 6]}
    curriculum = [stage | {"name": "near", "threshold": 0.5}, stage | {"name": "at"}]
    recipe = small(
        task="gym:torchrl_her/HandReach-v0",
        algo=algo,
        epochs=1,
        num_envs=4,
        warmup_frames=200,
        curriculum=curriculum if algo == "cher" else None,
    )
    rows = run(build(recipe), tmp_path / "run", progress=False).rows
    assert rows[-1]["rows_virtual"] > 0, rows[-1]
    assert 0.0 <= rows[-1]["success"] <= 1.0
    assert ("kl" in rows[-1]) == (algo == "filtered_her_ibs")


def test_an_id_that_gymnasium_does_not_know_is_named() -> None:
    with pytest.raises(ValueError, match="cannot make the gymnasium environment 'Nowhere-v7'"):
        build(small(task="gym:Nowhere-v7"))
