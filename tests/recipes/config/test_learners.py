"""The registry of learners."""

from __future__ import annotations

from typing import Any

import pytest

from torchrl_her_recipes import LEARNERS, LearnerBuilder, Recipe, make_recipe
from torchrl_her_recipes.config.choices.learners import SACConfig
from torchrl_her_recipes.config.values import load_name


@pytest.mark.parametrize("name", LEARNERS)
def test_every_learner_has_a_builder_and_options(name: str) -> None:
    assert issubclass(load_name(LEARNERS[name].maker), LearnerBuilder)
    assert type(make_recipe(learner=name).learner) is LEARNERS[name]


def test_options_in_python_are_those_of_their_learner() -> None:
    assert Recipe(learner=SACConfig(gamma=0.9)) == make_recipe(learner="sac", gamma=0.9)


def test_redq_is_sac_with_other_defaults() -> None:
    redq = make_recipe(learner="redq").learner
    sac = make_recipe(learner="sac", critics=10, target_critics=2).learner
    assert vars(redq) == vars(sac)
    assert LEARNERS["redq"].maker == LEARNERS["sac"].maker


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"learner": "sac", "target_critics": 3}, "target_critics=3 must be at most critics=2"),
        ({"learner": "td3", "critics": 4, "target_critics": 5}, "target_critics=5 must be at most critics=4"),
        ({"learner": "redq", "target_critics": -1}, "target_critics must be at least 0, got -1"),
        ({"learner": "tqc", "quantiles": 2}, "dropped_quantiles=2 must be below quantiles=2"),
        ({"learner": "tqc", "target_critics": 1}, "learner=tqc has no option target_critics"),
        ({"learner": "sac", "action_noise": 0.1}, "learner=sac has no option action_noise"),
        ({"action_noise": -0.1}, "action_noise must be at least 0, got -0.1"),
        ({"uniform_share": 1.1}, "uniform_share must be at least 0 and at most 1, got 1.1"),
        ({"frames_per_update": "inf"}, "frames_per_update must be finite, got inf"),
        ({"frames_per_update": 0}, "frames_per_update must be above 0, got 0.0"),
        ({"learning_rate": "inf"}, "learning_rate must be finite, got inf"),
        ({"action_penalty": "inf"}, "action_penalty must be finite, got inf"),
        ({"priority_beta": "inf"}, "priority_beta must be finite, got inf"),
        ({"sharpness": "inf", "algo": "filtered_her_rare"}, "sharpness must be finite, got inf"),
    ],
)
def test_options_that_cannot_be(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_recipe(**options)


@pytest.mark.parametrize("learner", LEARNERS)
def test_another_learner_has_its_own_defaults(learner: str) -> None:
    """And what was changed on purpose goes over to it."""
    for former in LEARNERS:
        task = "bit_flip" if "dqn" in (learner, former) else "hand_v0"
        full = make_recipe(task=task, learner=former, gamma=0.9).to_dict()
        assert make_recipe(full, learner=learner) == make_recipe(task=task, learner=learner, gamma=0.9)
    assert Recipe().replace(learner="sac", gamma=0.9) == make_recipe(learner="sac", gamma=0.9)


def test_an_unknown_learner_gets_a_hint() -> None:
    with pytest.raises(ValueError, match="learner must be one of ddpg, .*, got 'ddgp'; did you mean ddpg.$"):
        make_recipe(learner="ddgp")
    message = "learner=ddpg has no option critics; learner=td3 or sac or redq or tqc has it"
    with pytest.raises(ValueError, match=message):
        make_recipe(learner="ddpg", critics=3)
