"""The registry of learners."""

from __future__ import annotations

import pytest

from torchrl_her_recipes import LEARNERS, LearnerBuilder, LearnerSpec, Recipe, make_recipe, register_learner
from torchrl_her_recipes.config.learners import SACConfig, options_of
from torchrl_her_recipes.config.values import load_name


@pytest.mark.parametrize("name", LEARNERS)
def test_every_learner_has_a_builder_and_options(name: str) -> None:
    spec = LEARNERS[name]
    assert issubclass(load_name(spec.builder), LearnerBuilder)
    assert type(make_recipe(learner=name).learner) is spec.options is options_of(name)


@pytest.mark.parametrize("name", ["auto", "sac"])
def test_names_are_taken_once(name: str) -> None:
    with pytest.raises(ValueError, match=f"there is a learner '{name}' already"):
        register_learner(LearnerSpec(name=name, summary="", builder="a:b", options=SACConfig))


def test_the_name_and_the_class_of_options_must_agree() -> None:
    assert Recipe(learner=SACConfig(name="sac", gamma=0.9)).learner.gamma == 0.9
    with pytest.raises(ValueError, match="learner=auto takes a DDPGConfig, got a SACConfig: name"):
        Recipe(learner=SACConfig())


def test_an_unknown_learner_gets_a_hint() -> None:
    with pytest.raises(ValueError, match="unknown learner 'ddgp'; did you mean ddpg. The learners are auto"):
        make_recipe(learner="ddgp")
    with pytest.raises(ValueError, match="learner=ddpg has no option critics; the options are name"):
        make_recipe(learner="ddpg", critics=3)
