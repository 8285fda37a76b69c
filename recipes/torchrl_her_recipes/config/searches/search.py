"""Settings of a search for good options: its recipe, search space, sampler and pruner."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, get_args

from torchrl_her_recipes.config.options import AUTO
from torchrl_her_recipes.config.recipe import Recipe
from torchrl_her_recipes.config.searches.spaces import Space
from torchrl_her_recipes.config.shortcuts import short_name

Sampler = Literal["tpe", "random", "cmaes"]
Pruner = Literal["median", "halving", "none"]

SAMPLERS: tuple[str, ...] = get_args(Sampler)
PRUNERS: tuple[str, ...] = get_args(Pruner)


@dataclass(frozen=True, kw_only=True)
class Search:
    """Settings of a search for good options.

    Args:
        recipe: recipe of the trials, except for the options that are varied. Each trial trains ``num_runs``
            runs with the seeds from ``seed`` on. The sampler of options uses ``seed``, too.
        space: the options that are varied, with their ranges.
        sampler: method that chooses options of trials: ``tpe``, ``random`` or ``cmaes``.
        pruner: rule that ends trials early. ``median`` ends a trial if it is below the median of the other
            trials at the same epoch. ``halving`` ends all but the best third at a ninth and at a third of
            the epochs. ``none`` ends no trial.

    Raises:
        ValueError: the sampler or pruner is unknown, or the recipe does not accept the ranges of the space.

    Example:
        >>> from torchrl_her_recipes import make_recipe, space_for
        >>> recipe = make_recipe(task="hand_v0", num_runs=3)
        >>> Search(recipe=recipe, space=space_for(recipe)).sampler
        'tpe'
    """

    recipe: Recipe
    space: Space
    sampler: Sampler = "tpe"
    pruner: Pruner = "median"

    def __post_init__(self) -> None:
        for name, known in (("sampler", SAMPLERS), ("pruner", PRUNERS)):
            if getattr(self, name) not in known:
                raise ValueError(f"{name} must be one of {', '.join(known)}, got {getattr(self, name)!r}")
        numbers = [name for name, values in self.space.ranges.items() if values["kind"] != "choice"]
        if self.sampler == "cmaes" and len(numbers) < 2:
            raise ValueError(
                f"--sampler cmaes needs at least two numeric options, but the space {self.space.name} has "
                "fewer: choose tpe or random"
            )
        self.space.check(self.recipe)
        values = self.space.values_of(self.recipe)
        inside = self.space.inside(values)
        for name in numbers:
            if self.sampler == "cmaes" and values.get(name, AUTO) != AUTO and name not in inside:
                raise ValueError(
                    f"--sampler cmaes needs a space that contains the recipe's values, but {name}="
                    f"{values[name]} lies outside; widen its range, or choose --sampler tpe"
                )

    def to_plain(self) -> dict[str, Any]:
        """Returns the settings as plain values, which are written into the folder of the search."""
        return {
            "sampler": self.sampler,
            "pruner": self.pruner,
            "space": dict(self.space.ranges),
            "recipe": self.recipe.to_dict(),
        }


def difference(search: Mapping[str, Any], other: Mapping[str, Any]) -> str:
    """Describes the first difference between two searches, given as plain values; empty if they are equal.

    Example:
        >>> from torchrl_her_recipes import make_recipe, space_for
        >>> recipes = make_recipe(task="hand_v0"), make_recipe(task="hand_v0", seed=3)
        >>> one, other = (Search(recipe=recipe, space=space_for(recipe)) for recipe in recipes)
        >>> difference(one.to_plain(), other.to_plain())
        'seed=0, not seed=3'
    """
    first, second = _flat(search), _flat(other)
    for name in {**first, **second}:
        if first.get(name) != second.get(name):
            parts = (f"{name}={flat[name]}" if name in flat else f"no {name}" for flat in (first, second))
            return ", not ".join(parts)
    return ""


def _flat(search: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the values of a search by their names on the command line."""
    flat = {f"--{name}": search[name] for name in ("sampler", "pruner")}
    flat |= {f"space.{name}": values for name, values in search["space"].items()}
    for group, options in search["recipe"].items():
        for name, value in options.items():
            flat[short_name(group, name)] = value
    return flat
