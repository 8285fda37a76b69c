"""Weights of virtual goals: chosen by the algorithm or by name, with options of their own."""

from __future__ import annotations

from typing import Any

import pytest

from torchrl_her_recipes import ALGORITHMS, Algorithm, Recipe, make_recipe
from torchrl_her_recipes.config.choices.weights import IBS, RND, Equal, Rare, SequentialIBS
from torchrl_her_recipes.config.groups import HindsightConfig


def test_an_algorithm_has_its_weights() -> None:
    assert make_recipe(algo="her").weights == Equal()
    assert make_recipe(algo="filtered_her_ibs", sigma=0.3).weights == IBS(sigma=0.3)
    assert make_recipe(algo="her_ibs_sequential").weights == SequentialIBS()
    assert make_recipe(algo="cher_rare", memory=50).weights == Rare(memory=50)
    assert make_recipe(algo="filtered_her_rnd").changed() == {"hindsight": {"algo": "filtered_her_rnd"}}


def test_without_weights_of_the_algorithm_a_recipe_chooses() -> None:
    named, short = make_recipe(algo="cher", weights="rnd"), make_recipe(algo="cher_rnd")
    assert named.weights == short.weights == RND()
    for recipe in (named, short):
        assert Recipe.from_dict(recipe.to_dict()) == recipe
    assert named.replace(algo="her").weights == RND()
    assert named.replace(algo="her_ibs").weights == IBS()
    assert short.replace(algo="her").weights == Equal()
    assert named.replace(algo="no_hindsight").weights == Equal()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"algo": "her_ibs", "weights": "rare"},
            "weights must be ibs with algo=her_ibs, got rare; choose an",
        ),
        ({"algo": "her_ibs", "weights": "none"}, "weights must be ibs with algo=her_ibs, got none"),
        ({"algo": "no_hindsight", "weights": "rnd"}, "weights must be none with algo=no_hindsight, got rnd"),
        ({"weights": "rar"}, "weights must be one of none, .*, rnd, got 'rar'; did you mean rare"),
        (
            {"algo": "her_ibs_sequential", "floor": 0.3},
            "weights=ibs_sequential has no option floor; weights=i",
        ),
        ({"algo": "her_ibs", "memory": 50}, "weights=ibs has no option memory; weights=rare has it"),
        ({"algo": "cher_rnd", "estimator": "kernel"}, "weights=rnd has no option estimator"),
        ({"algo": "filtered_her_rare", "cells": 8}, "weights=rare has no option cells"),
        ({"novelty.memory": 50}, "novelty.memory is called weights.memory now"),
        ({"ibs": {"sigma": 0.3}}, "ibs.sigma is called weights.sigma now"),
        ({"algo": "her_ibs", "behavior": "ibs", "sigma": 0.3}, "write weights.sigma or behavior.sigma"),
        (
            {"behavior": "ibs", "recent": 50},
            "several groups have an option 'recent': write weights.recent or",
        ),
        (
            {"behavior": "ibs", "sigma": 0.3, "behavior.sigma": 0.4},
            "sigma and behavior.sigma set the same op",
        ),
    ],
)
def test_what_cannot_be_is_refused_by_name(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_recipe(**options)
    with pytest.raises(ValueError, match="weights must be ibs with algo=her_ibs, got none"):
        Recipe(hindsight=HindsightConfig(algo="her_ibs"))


def test_a_short_name_is_that_of_the_choice_that_has_it() -> None:
    recipe = make_recipe({"behavior": "ibs"}, algo="filtered_her_rnd", sigma=0.3, cells=8)
    assert recipe.changed()["behavior"] == {"name": "ibs", "sigma": 0.3, "cells": 8}
    assert recipe.replace(behavior="real", algo="her_ibs", sigma=0.1).weights == IBS(sigma=0.1)


def test_options_of_other_weights_are_dropped_from_a_base() -> None:
    base = {"weights": {"floor_is_relative": False, "sharpness": 2.0, "cells": 8}}
    assert make_recipe(base, algo="her_ibs").weights == IBS(floor_is_relative=False, cells=8)
    assert make_recipe(base, algo="her").weights == Equal(cells=8)
    assert make_recipe(base, weights="rnd").weights == RND(sharpness=2.0)


def test_an_algorithm_of_ones_own_names_its_weights(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(ALGORITHMS, "own", Algorithm(name="own", weights="rare", curriculum=True))
    recipe = make_recipe(algo="own", memory=50)
    assert recipe.weights == Rare(memory=50)
    assert recipe.hindsight.algorithm == ALGORITHMS["own"]
