"""Recipes on small worlds, with other learners, and with curricula from YAML."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from torchrl.objectives import DQNLoss, SACLoss, TD3Loss

from torchrl_her import DecayingEpsilonGreedy, GoalHistogram
from torchrl_her_envs import BitFlip, Chain, TreasureHunt, goal_env
from torchrl_her_recipes import Recipe
from torchrl_her_recipes.cli import main
from torchrl_her_recipes.running import resume

from .small import overrides, small


@pytest.mark.parametrize(
    ("task", "options", "kind"),
    [
        ("bit_flip", {"bits": 5, "useless_action": True}, BitFlip),
        ("treasure_hunt", {"step": 10}, TreasureHunt),
        ("chain", {"length": 6, "forward_probability": 0.9}, Chain),
    ],
)
@pytest.mark.parametrize("algo", ["no_hindsight", "her", "filtered_her"])
def test_small_worlds_train_by_name(task: str, options: dict[str, Any], kind: type, algo: str) -> None:
    parts = small(task=task, task_options=options, algo=algo, num_runs=2).build()
    assert isinstance(goal_env(parts.env), kind)
    assert isinstance(parts.loss, DQNLoss)
    rows = parts.run(progress=False).rows
    assert len(rows) == 4
    assert all(-50.0 <= row["q"] <= 10.0 and row["loss"] > 0 for row in rows)


def test_a_run_of_dqn_equals_the_single_run_with_its_seed() -> None:
    """To rounding: batched products add up in another order."""
    common: dict[str, Any] = {"task": "bit_flip", "task_options": {"bits": 4}, "algo": "her", "epochs": 1}
    both = small(**common, num_runs=2, seed=3).build().run(progress=False).rows
    alone = small(**common, seed=4).build().run(progress=False).rows
    assert both[1]["rows_virtual"] == pytest.approx(alone[0]["rows_virtual"], rel=0.05)
    assert both[1]["loss"] == pytest.approx(alone[0]["loss"], rel=0.2)


def test_bit_flip_of_few_bits_is_solved() -> None:
    recipe = small(task="bit_flip", task_options={"bits": 5}, algo="her", epochs=3, frames_per_update=4)
    parts = Recipe(**{**vars(recipe), "eval_episodes": 50, "learning_rate": 3e-3}).build()
    assert isinstance(parts.exploration, DecayingEpsilonGreedy)
    assert parts.run(progress=False).success >= 0.9


def test_small_worlds_go_on_from_checkpoints_bit_for_bit(tmp_path: Path) -> None:
    options: dict[str, Any] = {"task": "treasure_hunt", "task_options": {"step": 20}, "algo": "filtered_her"}
    small(**options, epochs=3).build().run(tmp_path / "whole", progress=False)
    small(**options, epochs=2).build().run(tmp_path / "half", progress=False)
    config = tmp_path / "half" / "config.yaml"
    config.write_text(config.read_text().replace("epochs: 2", "epochs: 3"))
    rows = resume(tmp_path / "half", progress=False).rows
    whole = yaml.safe_load((tmp_path / "whole" / "config.yaml").read_text())
    assert whole["task_options"] == {"step": 20}
    assert rows[-1]["q"] == small(**options, epochs=3).build().run(progress=False).rows[-1]["q"]


def test_goals_on_a_line_may_be_preferred_and_bits_may_not() -> None:
    parts = small(task="treasure_hunt", algo="her_ibs").build()
    assert isinstance(parts.buffer.writer.weights, GoalHistogram)
    assert parts.goal_target is not None
    assert parts.goal_target.shape == (20,)
    assert parts.run(progress=False).rows[-1]["kl"] >= 0
    with pytest.raises(ValueError, match="bit_flip: its goals have 15 numbers, and a grid is kept over 3"):
        small(task="bit_flip", algo="her_ibs").build()


@pytest.mark.parametrize(("learner", "loss"), [("td3", TD3Loss), ("sac", SACLoss)])
def test_other_learners_train_by_name(learner: str, loss: type, tmp_path: Path) -> None:
    recipe = small(algo="filtered_her", learner=learner)
    parts = recipe.build()
    assert isinstance(parts.loss, loss)
    before = torch.cat([p.detach().flatten().clone() for p in parts.actor.parameters()])
    rows = parts.run(tmp_path / "run", progress=False).rows
    after = torch.cat([p.detach().flatten() for p in parts.actor.parameters()])
    assert not torch.equal(before, after)
    assert rows[-1]["loss_qvalue"] > 0
    again = recipe.build().run(progress=False).rows
    assert [row["q"] for row in again] == [row["q"] for row in rows]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"task": "bit_flip", "learner": "sac"}, "finite number of actions: choose dqn"),
        ({"task": "hand_v0", "learner": "dqn"}, "continuous actions: choose ddpg or td3 or sac"),
        ({"learner": "sac", "num_runs": 2}, "num_runs must be 1 with learner=sac"),
        ({"task": "bit_flip", "task_options": {"bots": 3}}, "bit_flip does not take task_options.*bots"),
        ({"task_options": {"bits": 3}}, "hand_v0 takes no task_options"),
        ({"task": "chain", "task_options": 7}, "task_options must be a mapping of options, got 7"),
        ({"task": "chain", "threshold": 0.1}, "threshold is for throwing tasks"),
        ({"task": "bit_flip", "algo": "cher"}, "BitFlip has no curriculum"),
        ({"task": "treasure_hunt", "algo": "cher", "curriculum": [{"name": "all"}]}, "is no layer"),
        ({"task": "hand_v1", "algo": "cher", "curriculum": {"name": "all"}}, "must be a list of layers"),
    ],
)
def test_what_cannot_be_is_said_in_a_line(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        small(**options).build()


def test_unknown_names_list_what_there_is() -> None:
    with pytest.raises(
        ValueError, match=r"unknown task 'hand_v9'; the tasks are hand_reach.*chain, or gym:ID"
    ):
        small(task="hand_v9")
    with pytest.raises(ValueError, match="learner must be one of auto, ddpg, td3, sac, dqn, got 'ppo'"):
        small(learner="ppo")
    with pytest.raises(ValueError, match="curriculum must be a list of layers or a YAML file of one"):
        small(curriculum="nowhere.yaml")


def test_a_curriculum_comes_from_a_file(tmp_path: Path) -> None:
    """The state of treasure_hunt is [place, goal]: half of the way first, then all of it."""
    layers = [
        {"name": "coarse", "observation": [0], "achieved_goal": [0], "desired_goal": [1], "threshold": 0.5},
        {"name": "fine", "observation": [0], "achieved_goal": [0], "desired_goal": [1], "threshold": 0.1},
    ]
    path = tmp_path / "layers.yaml"
    path.write_text(yaml.safe_dump(layers))
    folder = tmp_path / "run"
    options = overrides(task="treasure_hunt", algo="cher", curriculum=path, folder=folder)
    assert main(["train", *options, "task_options={step: 10}"]) == 0
    config = yaml.safe_load((folder / "config.yaml").read_text())
    assert config["curriculum"] == layers


# Gymnasium's environments


@pytest.mark.parametrize("algo", ["her", "filtered_her_ibs", "cher"])
def test_an_environment_of_gymnasium_trains_by_its_id(algo: str, tmp_path: Path) -> None:
    """One of ours, on its way out to gymnasium and in again: its state is [hand, 5 | ball, 2]."""
    layer = {"observation": [0, 1, 2, 3, 4], "achieved_goal": [0, 1], "desired_goal": [5, 6]}
    curriculum = [layer | {"name": name, "threshold": far} for name, far in (("near", 0.5), ("at", 0.1))]
    recipe = small(
        task="gym:torchrl_her/HandReach-v0",
        algo=algo,
        epochs=1,
        epoch_frames=480,
        num_envs=4,
        warmup_frames=200,
        curriculum=curriculum if algo == "cher" else None,
    )
    rows = recipe.build().run(tmp_path / "run", progress=False).rows
    assert rows[-1]["rows_virtual"] > 0, rows[-1]
    assert 0.0 <= rows[-1]["success"] <= 1.0
    assert ("kl" in rows[-1]) == (algo == "filtered_her_ibs")


def test_an_id_that_gymnasium_does_not_know_is_named() -> None:
    with pytest.raises(ValueError, match="cannot make the gymnasium environment 'Nowhere-v7'"):
        small(task="gym:Nowhere-v7").build()
