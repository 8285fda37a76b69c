"""Options without effect are refused when they are asked for, and dropped when they come from a preset."""

from __future__ import annotations

from typing import Any

import pytest

from torchrl_her_recipes import ALGORITHMS, Algorithm, Recipe, make_recipe

IDLE = [
    ({"algo": "no_hindsight"}, {"k": 8}),
    ({"algo": "no_hindsight"}, {"cells": 8}),
    ({"k": 0}, {"strategy": "final"}),
    ({"k": 0, "algo": "her_ibs"}, {"sigma": 0.3}),
    ({"algo": "her"}, {"sigma": 0.3}),
    ({"algo": "her"}, {"floor": 0.3}),
    ({"algo": "her_ibs_sequential"}, {"floor": 0.3}),
    ({"algo": "her"}, {"window": 5}),
    ({"algo": "cher", "learner": "sac"}, {"layer_epsilon": 0.5}),
    ({"sampler": "uniform"}, {"priority_alpha": 0.5}),
    ({"sampler": "uniform"}, {"priority_beta": 0.5}),
    ({"hard_update_interval": 3}, {"tau": 0.5}),
    ({"processes": 0}, {"sync": False}),
    ({"task": "bit_flip"}, {"threshold": 0.5}),
    ({"task": "chain"}, {"dtype": "float64"}),
    ({"task": "gym:FetchReach-v4"}, {"dtype": "float64"}),
]


@pytest.mark.parametrize(("options", "idle"), IDLE)
def test_what_has_no_effect_is_refused_by_name(options: dict[str, Any], idle: dict[str, Any]) -> None:
    (name,) = idle
    with pytest.raises(ValueError, match=f"^{name}=.* has no effect with .*: leave it out"):
        make_recipe(**options, **idle)


@pytest.mark.parametrize(("options", "idle"), IDLE)
def test_what_has_no_effect_is_dropped_from_a_preset(options: dict[str, Any], idle: dict[str, Any]) -> None:
    assert make_recipe(idle, **options) == make_recipe(**options)


@pytest.mark.parametrize(
    "options",
    [
        {"algo": "her", "cells": 8},  # goals are counted
        {"algo": "her_ibs_sequential", "sigma": 0.3},
        {"algo": "cher", "layer_epsilon": 0.5},
        {"task": "hand_v0", "threshold": 0.5, "dtype": "float64"},
    ],
)
def test_what_has_an_effect_is_kept(options: dict[str, Any]) -> None:
    recipe = make_recipe(**options)
    assert Recipe.from_dict(recipe.to_dict()) == recipe != make_recipe(task=recipe.task.name)


def test_weights_of_ones_own_may_read_every_option_of_ibs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(ALGORITHMS, "own", Algorithm(name="own", weights="nowhere:make"))
    assert make_recipe(algo="own", sigma=0.3).ibs.sigma == 0.3


def test_options_of_another_task_do_not_come_along() -> None:
    base = make_recipe(**{"task": "bit_flip", "task.options": {"bits": 4, "max_steps": 9}})
    assert base.replace(task="treasure_hunt").task.options == {"max_steps": 9}
    assert base.replace(task="hand_v0").task.options is None
