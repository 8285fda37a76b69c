"""Agents: the learner that a recipe and the actions of an environment ask for."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import torch
from torchrl.envs import EnvBase

from torchrl_her_recipes import Recipe, build, load_preset, make_recipe, run
from torchrl_her_recipes.components.agents import find_builder, find_learner, make_agent, shape_of
from torchrl_her_recipes.components.envs import TaskEnvs
from torchrl_her_recipes.config.choices.learners import LearnerConfig, SACConfig

from ..small import SMALL, small


def learner_of(recipe: Recipe, env: EnvBase) -> type[LearnerConfig]:
    return find_learner(recipe.learner, shape_of(recipe.task.name, recipe.run, env))


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"task": "hand_v0"}, "ddpg"),
        ({"task": "bit_flip"}, "dqn"),
        ({"task": "hand_v0", "learner": "sac"}, "sac"),
    ],
)
def test_auto_follows_the_actions(options: dict[str, Any], name: str) -> None:
    recipe = small(**options)
    assert learner_of(recipe, TaskEnvs.of(recipe).make(1, [0])).name == name


def test_an_option_of_ddpg_is_refused_where_auto_turns_out_to_be_dqn() -> None:
    """Where the name of the task does not tell its actions, this is known when the environment is made."""
    recipe = Recipe.from_dict({"task": {"name": "bit_flip"}, "learner": {"action_penalty": 0.5}})
    with pytest.raises(ValueError, match="action_penalty=0.5 has no effect with learner=dqn: leave it out$"):
        learner_of(recipe, TaskEnvs.of(recipe).make(1, [0]))


def test_a_learner_that_explores_by_itself_gets_no_epsilon_when_a_stage_begins(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    components = build(small(task="hand_v1", algo="cher", learner="sac", window=1))
    progress = components.curriculum.progress
    record = progress.record
    monkeypatch.setattr(progress, "record", lambda samples: record(torch.ones_like(samples)))
    run(components, progress=False)
    assert progress.stages == (1,)
    assert components.exploration.epsilon.tolist() == [0.0]


def test_options_reach_the_loss_and_the_exploration() -> None:
    td3 = build(
        small(
            task="hand_v0",
            learner="td3",
            critics=5,
            target_critics=2,
            target_noise=0.3,
            action_noise=0.1,
            uniform_share=0.3,
            epsilon_start=1.0,
            epsilon_end=1.0,
        )
    )
    assert (td3.loss.num_qvalue_nets, td3.loss.target_critics, td3.loss.target_noise) == (5, 2, 0.3)
    assert (td3.exploration.noise, td3.exploration.uniform_share) == (0.1, 0.3)
    redq = build(small(task="hand_v0", learner="redq", clamp_targets=True, gamma=0.9))
    assert (redq.loss.num_qvalue_nets, redq.loss.target_critics) == (10, 2)
    assert [redq.loss.value_estimator.low, redq.loss.value_estimator.high] == pytest.approx([-10.0, 0.0])
    tqc = build(small(task="hand_v0", learner="tqc", quantiles=7, dropped_quantiles=3))
    assert tqc.loss.top_quantiles_to_drop_per_net == 3
    assert tqc.critic.module.outputs == 7
    assert tqc.loss.value_estimator.low == -math.inf  # not clamped


@pytest.mark.parametrize(("task", "learner"), [("hand_v0", "ddpg"), ("hand_v0", "td3"), ("bit_flip", "dqn")])
def test_targets_are_clamped_unless_they_shall_not(task: str, learner: str) -> None:
    made = [build(small(task=task, learner=learner, **own)) for own in ({}, {"clamp_targets": False})]
    clamped, free = (own.loss.value_estimator for own in made)
    assert [clamped.low, clamped.high] == pytest.approx([-50.0, 0.0])
    assert [free.low, free.high] == [-math.inf, math.inf]


def test_with_the_preset_of_throwing_exploration_is_that_of_the_thesis() -> None:
    exploration = build(make_recipe({**load_preset("throwing"), **SMALL}, task="hand_v0")).exploration
    assert (exploration.noise, exploration.uniform_share) == (0.05, 0.2)


def test_targets_cannot_be_clamped_where_rewards_have_no_bounds(monkeypatch: pytest.MonkeyPatch) -> None:
    recipe = small(task="hand_v0", learner="sac", clamp_targets=True)
    env = TaskEnvs.of(recipe).make(1, [0])
    shape = shape_of("hand_v0", recipe.run, env, rewards=(-math.inf, 0.0))
    with pytest.raises(ValueError, match="clamp_targets=true has no effect on hand_v0, whose rewards have"):
        make_agent(find_builder(recipe.learner, shape), [0], curriculum=recipe.curriculum)


def test_a_learner_may_be_for_one_run_only(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(SACConfig, "stacks", False)
    recipe = small(task="hand_v0", learner="sac", num_runs=2)
    with pytest.raises(ValueError, match="num_runs must be 1 with learner=sac"):
        learner_of(recipe, TaskEnvs.of(recipe).make(2, [0, 1]))


@pytest.mark.parametrize("compile", ["always", "never"])
@pytest.mark.parametrize(
    "options",
    [
        {"learner": "td3"},
        {"learner": "sac"},
        {"learner": "tqc", "quantiles": 5},
        {"learner": "redq", "target_critics": 0},
    ],
    ids=lambda own: own["learner"],
)
def test_one_critic_learns_and_begins_with_the_weights_of_its_seed(
    options: dict[str, Any], compile: str, tmp_path: Path
) -> None:
    recipe = small(critics=1, hidden=8, epochs=1, compile=compile, **options)
    first, second = build(recipe), build(recipe.replace(seed=1, num_runs=2))
    before = {name: value.clone() for name, value in first.loss.state_dict().items() if "qvalue" in name}
    other = build(recipe.replace(seed=1)).loss.state_dict()
    for name, value in before.items():
        weights = second.loss.state_dict()[name][:, :1]
        assert torch.equal(weights, other[name][:, :1])  # of the first run, which has the seed 1
        assert value.min() == value.max() or not torch.equal(weights, value[:, :1])  # or they begin alike
    run(first, tmp_path / "run", progress=False)
    after = first.loss.state_dict()
    assert not any(torch.equal(value, after[name]) for name, value in before.items())
