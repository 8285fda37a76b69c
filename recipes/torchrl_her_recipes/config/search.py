"""A search for good options: what it varies, around which recipe, and how it chooses."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal, get_args

from torchrl_her_recipes.config.options import AUTO
from torchrl_her_recipes.config.recipe import Recipe
from torchrl_her_recipes.config.spaces import Space, make_space

Sampler = Literal["tpe", "random", "cmaes"]
Pruner = Literal["median", "halving", "none"]

SAMPLERS: tuple[str, ...] = get_args(Sampler)
PRUNERS: tuple[str, ...] = get_args(Pruner)


@dataclass(frozen=True, kw_only=True)
class Search:
    """A search for good options.

    Args:
        recipe: what a trial runs, but for the options that are varied. Its ``num_runs`` runs are the seeds of
            each trial, and its ``seed`` is also that of the sampler.
        space: the options that are varied.
        sampler: ``tpe``, ``random`` or ``cmaes``.
        pruner: which trials are ended early: ``median``, those below the median of the others at the same
            epoch; ``halving``, all but the best third at a ninth and at a third of the epochs; ``none``.

    Raises:
        ValueError: an unknown sampler or pruner, or a space that the recipe does not take.

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
        if self.sampler == "cmaes" and sum(entry.kind != "choice" for entry in self.space) < 2:
            raise ValueError(
                f"--sampler cmaes needs two options that are no choices, and the space {self.space.name} "
                "has fewer: take tpe or random"
            )
        self.space.check(self.recipe)
        own = self.space.values_of(self.recipe)
        for entry in self.space:
            value = own.get(entry.name, AUTO)
            numbers = self.sampler == "cmaes" and entry.kind != "choice"
            if numbers and value != AUTO and not entry.holds(value):
                raise ValueError(
                    f"--sampler cmaes needs a space with the recipe's own values, and {entry.name}={value} "
                    "lies outside; widen its range, or choose --sampler tpe"
                )

    def to_plain(self) -> dict[str, Any]:
        """The search as plain values, as its folder keeps them."""
        return {
            "sampler": self.sampler,
            "pruner": self.pruner,
            "space": self.space.to_plain(),
            "recipe": self.recipe.to_dict(),
        }

    @classmethod
    def from_plain(cls, values: Mapping[str, Any]) -> Search:
        """The search that :meth:`to_plain` was asked of.

        Raises:
            ValueError: the values are not those of a search.
        """
        known = ("sampler", "pruner", "space", "recipe")
        if set(values) != set(known) or not isinstance(values["recipe"], Mapping):
            raise ValueError(f"a search has {', '.join(known)}, got {', '.join(map(str, values))}")
        return cls(
            recipe=Recipe.from_dict(values["recipe"]),
            space=make_space("of the folder", values["space"]),
            sampler=values["sampler"],
            pruner=values["pruner"],
        )

    def difference(self, other: Search) -> str:
        """What differs in another search, as ``mine, not theirs``; empty if nothing does.

        Example:
            >>> from torchrl_her_recipes import make_recipe, space_for
            >>> recipe = make_recipe(task="hand_v0")
            >>> one = Search(recipe=recipe, space=space_for(recipe))
            >>> one.difference(Search(recipe=recipe.replace(seed=3), space=one.space))
            'seed=0, not seed=3'
        """
        theirs = dict(_flat(other))
        mine = dict(_flat(self))
        for name in [*mine, *theirs]:
            if mine.get(name) != theirs.get(name):
                return f"{_shown(name, mine)}, not {_shown(name, theirs)}"
        return ""


def _shown(name: str, values: Mapping[str, Any]) -> str:
    return f"{name}={values[name]}" if name in values else f"no {name}"


def _flat(search: Search) -> Iterator[tuple[str, Any]]:
    yield "--sampler", search.sampler  # as on the command line; recipes have a sampler, too
    yield "--pruner", search.pruner
    for name, entry in search.space.to_plain().items():
        yield f"space.{name}", entry
    for group, options in search.recipe.to_dict().items():
        for name, value in options.items():
            shown = f"demonstrations.{name}" if group == "demonstrations" else name
            yield group if name == "name" else shown, value
