"""Agents: the learner that a recipe and the actions of an environment ask for."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch

from torchrl_her_recipes import build, run
from torchrl_her_recipes.components.agents import find_learner, make_networks
from torchrl_her_recipes.components.envs import make_task_envs
from torchrl_her_recipes.config.learners import LEARNERS

from ..small import small


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
    assert find_learner(recipe, make_task_envs(recipe, 1, [0])).name == name


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"task": "bit_flip", "learner": "td3"},
            "not be used on bit_flip, .* discrete actions: choose dqn",
        ),
        ({"task": "hand_v0", "learner": "dqn"}, "continuous actions: choose ddpg or td3 or sac"),
        (
            {"task": "bit_flip", "action_penalty": 0.5},
            "with learner=dqn: leave it out or write learner=dqn",
        ),
    ],
)
def test_what_does_not_fit_is_refused(options: dict[str, Any], message: str) -> None:
    recipe = small(**options)
    with pytest.raises(ValueError, match=message):
        find_learner(recipe, make_task_envs(recipe, 1, [0]))


def test_the_weights_of_a_run_depend_on_its_own_seed_alone() -> None:
    recipe = small(task="hand_v0", num_runs=2, seed=3)
    env = make_task_envs(recipe, 1, recipe.seeds)
    both, _ = make_networks(recipe, env)
    alone, _ = make_networks(small(task="hand_v0", seed=4), env)
    for stacked, own in zip(both.parameters(), alone.parameters(), strict=True):
        assert torch.equal(stacked[1], own.view_as(stacked[1]))


def test_a_learner_that_explores_by_itself_gets_no_epsilon_when_a_layer_begins(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    components = build(small(task="hand_v1", algo="cher", learner="sac", window=1))
    assert components.curriculum is not None
    progress = components.curriculum.progress
    record = progress.record
    monkeypatch.setattr(progress, "record", lambda samples: record(torch.ones_like(samples)))
    run(components, progress=False)
    assert progress.layers == (1,)
    assert components.exploration.epsilon.tolist() == [0.0]


def test_a_learner_may_be_for_one_run_only(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(LEARNERS, "sac", replace(LEARNERS["sac"], stacks=False))
    recipe = small(task="hand_v0", learner="sac", num_runs=2)
    with pytest.raises(ValueError, match="num_runs must be 1 with learner=sac"):
        find_learner(recipe, make_task_envs(recipe, 2, [0, 1]))
