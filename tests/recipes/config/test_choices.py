"""Choices of a recipe: one's own, options of others, and files that name these."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

from torchrl_her_recipes import BEHAVIOR, Proposed, Recipe, build, make_recipe, option
from torchrl_her_recipes.cli import main
from torchrl_her_recipes.config import algorithms
from torchrl_her_recipes.config.algorithms import Algorithm, register_algorithm
from torchrl_her_recipes.config.choices.behavior import Behavior, Mega, Real
from torchrl_her_recipes.config.choices.kind import Kind
from torchrl_her_recipes.config.shortcuts import KINDS

from ..small import small

MEGA = {"name": "mega", "real_share": 0.5, "goal_memory": 50_000, "candidates": 100, "cutoff": -5.0}


def test_a_recipe_has_the_options_of_its_choice_alone() -> None:
    recipe = make_recipe(behavior="mega", cutoff=-5)
    assert (
        recipe == make_recipe(behavior={"name": "mega", "cutoff": -5}) == Recipe(behavior=Mega(cutoff=-5.0))
    )
    assert recipe.to_dict()["behavior"] == MEGA
    assert recipe.changed() == {"behavior": {"name": "mega", "cutoff": -5.0}}
    assert Recipe.from_dict(recipe.to_dict()) == recipe
    assert Recipe().to_dict()["behavior"] == {"name": "real"}


def test_another_choice_takes_those_options_of_a_base_that_it_has() -> None:
    base = {"behavior": {**MEGA, "real_share": 0.25}}
    assert make_recipe(base, behavior="ibs").changed() == {"behavior": {"name": "ibs", "real_share": 0.25}}
    assert make_recipe(base, behavior="real") == Recipe()


def test_a_name_is_taken_once() -> None:
    kind = Kind("behavior", Behavior, default="real")
    assert kind.register(Real) is Real
    with pytest.raises(ValueError, match="behavior=real is registered already"):
        kind.register(type("Real", (Real,), {}))
    with pytest.raises(ValueError, match="behavior=real is registered already"):
        kind.register(type("Other", (Real,), {"__module__": Real.__module__}))
    assert kind["real"] is Real


def test_a_class_that_is_defined_again_replaces_itself() -> None:
    kind = Kind("behavior", Behavior, default="real")
    kind.register(Real)
    again = type("Real", (Behavior,), {"name": "real", "__module__": Real.__module__})
    assert kind.register(again) is again
    assert kind["real"] is again


def test_an_algorithm_is_registered_again_if_it_is_equal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(algorithms, "ALGORITHMS", dict(algorithms.ALGORITHMS))
    for _ in range(2):
        register_algorithm(Algorithm("her_right", filter=True, weights="right"))
    for name in ("her_right", "her"):
        with pytest.raises(ValueError, match=f"there is an algorithm '{name}' already"):
            register_algorithm(Algorithm(name, weights="right"))


def test_a_name_that_resembles_no_other_may_be_one_of_a_module() -> None:
    with pytest.raises(ValueError, match="got 'xyz'; to use your own, import the module that registers it"):
        make_recipe(behavior="xyz")


def test_every_choice_has_a_summary(capsys: pytest.CaptureFixture[str]) -> None:
    main(["list"])
    listed = capsys.readouterr().out
    for name, summary in (choice for kind in KINDS.values() for choice in kind.summaries().items()):
        assert f"  {name:<20} {summary}\n" in listed
        assert "(*" not in summary  # the signature, without a docstring


def test_a_maker_that_does_not_exist_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    @dataclass(frozen=True, kw_only=True)
    class Lost(Proposed):
        """A choice without its maker."""

        name = "lost"
        maker = "lost_module:make"
        depth: int = option(3, "how far", at_least=1)

    monkeypatch.setitem(BEHAVIOR, "lost", Lost)
    recipe = small(task="hand_v0", algo="her", behavior="lost", **{"behavior.depth": 5, "goal_memory": 100})
    assert recipe.behavior == Lost(depth=5, goal_memory=100)
    with pytest.raises(ValueError, match="'lost_module:make' must name an attribute of a module"):
        build(recipe)
