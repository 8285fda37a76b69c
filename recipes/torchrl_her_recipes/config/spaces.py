"""Spaces: which options a search varies, and in which ranges."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from reprlib import Repr
from textwrap import shorten
from typing import Any, Literal, get_args

from torchrl_her_envs.registry import get_task_spec
from torchrl_her_recipes.config.learners import BY_ACTIONS
from torchrl_her_recipes.config.options import AUTO, what_there_is
from torchrl_her_recipes.config.plain_files import read_yaml
from torchrl_her_recipes.config.recipe import Recipe, compose, drop_other_goal_sources
from torchrl_her_recipes.config.shipped import CONF
from torchrl_her_recipes.config.shortcuts import locate, merge, place
from torchrl_her_recipes.config.values import as_kind
from torchrl_her_recipes.config.without_effect import without_effect

Kind = Literal["float", "log_float", "int", "log_int", "choice"]

_KINDS = get_args(Kind)
_SPACES = CONF / "space"
_MOST = 100  # values of a choice
# Trials must be of the same length and start, or they could not be compared; files are the search's own.
_SAME_FOR_ALL = ("task", "seed", "num_runs", "epochs", "epoch_frames", "checkpoint_interval", "keep_buffer")

_repr = Repr()
_repr.maxlevel, _repr.maxdict, _repr.maxlist, _repr.maxtuple, _repr.maxother = 2, 4, 4, 4, 60


@dataclass(frozen=True, kw_only=True)
class Entry:
    """One option that is varied.

    Args:
        name: of the option, short or with its group.
        kind: ``float`` or ``int``, each also as ``log_float`` and ``log_int``, which are drawn evenly in
            their logarithm; or ``choice``.
        low: the smallest value; of a choice None.
        high: the largest value; of a choice None.
        values: those of a choice.

    Raises:
        ValueError: an unknown option or kind, or a range that holds nothing; the message names it.
    """

    name: str
    kind: Kind
    low: float | None = None
    high: float | None = None
    values: tuple[Any, ...] = ()

    def __post_init__(self) -> None:
        group, own = locate(self.name)
        if own in _SAME_FOR_ALL or (group, own) == ("task", "name"):
            raise ValueError(f"{self.name} must be the same in all trials of a search: it cannot be varied")
        if self.kind not in _KINDS:
            raise ValueError(
                f"kind of {self.name} must be one of {', '.join(_KINDS)}, got {_repr.repr(self.kind)}"
            )
        if self.kind == "choice":
            self._check_choice()
        else:
            self._check_range()

    @property
    def ends(self) -> tuple[Any, ...]:
        """The values that a recipe must take: both ends of the range, or all of a choice."""
        return self.values if self.kind == "choice" else (self.low, self.high)

    def holds(self, value: Any) -> bool:
        """Whether a value is one that the search may choose.

        Example:
            >>> Entry(name="gamma", kind="float", low=0.9, high=0.99).holds(0.95)
            True
        """
        if self.kind == "choice":
            return value in self.values
        assert self.low is not None
        assert self.high is not None
        return isinstance(value, int | float) and self.low <= value <= self.high

    def suggest(self, trial: Any) -> Any:
        """The value that a trial of Optuna has, or now gets."""
        if self.kind == "choice":
            return trial.suggest_categorical(self.name, self.values)
        assert self.low is not None
        assert self.high is not None
        log = self.kind.startswith("log")
        if self.kind.endswith("float"):
            return trial.suggest_float(self.name, self.low, self.high, log=log)
        return trial.suggest_int(self.name, int(self.low), int(self.high), log=log)

    def to_plain(self) -> dict[str, Any]:
        """What stands behind the name of the option in a file."""
        if self.kind == "choice":
            return {"kind": self.kind, "values": list(self.values)}
        return {"kind": self.kind, "low": self.low, "high": self.high}

    def _check_choice(self) -> None:
        if self.low is not None or self.high is not None:
            raise ValueError(f"{self.name} is a choice and has values, not low and high")
        if not all(value is None or isinstance(value, str | int | float) for value in self.values):
            raise ValueError(
                f"values of {self.name} must be numbers, texts, true or false, got {_repr.repr(self.values)}"
            )
        if len({(type(value), value) for value in self.values}) != len(self.values):
            raise ValueError(f"values of {self.name} must differ, got {_repr.repr(self.values)}")
        if not 2 <= len(self.values) <= _MOST:
            raise ValueError(f"{self.name} must have 2 to {_MOST} values, got {len(self.values)}")

    def _check_range(self) -> None:
        if self.values:
            raise ValueError(f"{self.name} is a {self.kind} and has low and high, not values")
        for end in ("low", "high"):
            value = getattr(self, end)
            if value is None:
                raise ValueError(f"{self.name} is a {self.kind} and needs {end}")
            if not isinstance(value, str | int | float):
                raise ValueError(f"{end} of {self.name} must be a number, got {_repr.repr(value)}")
            number = as_kind(f"{end} of {self.name}", value, float if "float" in self.kind else int)
            if not math.isfinite(number) or abs(number) > 1e15:
                raise ValueError(f"{end} of {self.name} must be finite, got {number}")
            object.__setattr__(self, end, number)
        assert self.low is not None
        assert self.high is not None
        if self.low >= self.high:
            raise ValueError(f"low of {self.name} must be below high, got {self.low} and {self.high}")
        if self.kind.startswith("log") and self.low <= 0:
            raise ValueError(f"low of {self.name}, a {self.kind}, must be above 0, got {self.low}")


@dataclass(frozen=True, kw_only=True)
class Space:
    """The options that a search varies.

    With Optuna's own ``optimize``::

        def objective(trial):
            return run_score(space.recipe(recipe, space.suggest(trial)))

    Args:
        name: what messages call it.
        entries: one for each option.

    Raises:
        ValueError: there are none, or two for one option.
    """

    name: str
    entries: tuple[Entry, ...]

    def __post_init__(self) -> None:
        if not self.entries:
            raise ValueError(f"the space {self.name} varies nothing")
        places = [locate(entry.name) for entry in self.entries]
        for home, entry in zip(places, self.entries, strict=True):
            if places.count(home) > 1:
                raise ValueError(f"the space {self.name} has two entries for {entry.name}")

    def __iter__(self) -> Iterator[Entry]:
        return iter(self.entries)

    def to_plain(self) -> dict[str, Any]:
        """What a file of it holds."""
        return {entry.name: entry.to_plain() for entry in self.entries}

    def without(self, names: Mapping[str, Any]) -> Space:
        """The space without options whose values are given.

        Raises:
            ValueError: nothing is left.

        Example:
            >>> load_space("dqn").without({"learner.gamma": 0.9}).to_plain().get("gamma")
        """
        given = {locate(".".join(name.split(".")[:2])) for name in names}
        left = tuple(entry for entry in self.entries if locate(entry.name) not in given)
        if not left:
            raise ValueError(f"all options of the space {self.name} are given: there is nothing to search")
        return replace(self, entries=left)

    def with_effect(self, recipe: Recipe) -> Space:
        """The space without options that have no effect on a recipe."""
        idle = _idle(recipe)
        return replace(self, entries=tuple(own for own in self.entries if locate(own.name) not in idle))

    def check(self, recipe: Recipe) -> None:
        """Makes sure that a recipe takes the ends of all ranges, and all values of choices.

        Raises:
            ValueError: it does not; the message names the option.
        """
        for entry in self.entries:
            for value in entry.ends:
                try:
                    recipe.replace(**{entry.name: value})
                except ValueError as error:
                    raise ValueError(f"the space {self.name} does not fit: {error}") from error

    def suggest(self, trial: Any) -> dict[str, Any]:
        """The values that a trial of Optuna has, or now gets.

        Args:
            trial: of Optuna, or any object with its ``suggest_float``, ``suggest_int`` and
                ``suggest_categorical``.

        Returns:
            Values by the names of the options, as :func:`~torchrl_her_recipes.make_recipe` takes them.
        """
        return {entry.name: entry.suggest(trial) for entry in self.entries}

    def recipe(self, base: Recipe, values: Mapping[str, Any]) -> Recipe:
        """A recipe with some values of the options that are varied.

        Values without effect besides the others are left out; k and strategy replace goal_sources.

        Raises:
            ValueError: values that cannot go together.
        """
        given = place(values)
        drop_other_goal_sources(given)
        return compose(merge(base.to_dict(), given), {})

    def values_of(self, recipe: Recipe) -> dict[str, Any]:
        """A recipe's values of the options that have an effect, in the space or outside."""
        idle = _idle(recipe)
        places = {entry.name: locate(entry.name) for entry in self.entries}
        return {
            name: getattr(getattr(recipe, group), own)
            for name, (group, own) in places.items()
            if (group, own) not in idle
        }


def _idle(recipe: Recipe) -> set[tuple[str, str]]:
    """The options that have no effect on a recipe, as (group, name)."""
    idle = set(without_effect(recipe))
    if recipe.hindsight.goal_sources == AUTO:  # sources that a run takes in place of k and strategy
        idle |= {("hindsight", "k"), ("hindsight", "strategy")}
    return idle


def space_names() -> list[str]:
    """All spaces that come with the package: one for each of its learners."""
    return sorted(path.stem for path in _SPACES.glob("*.yaml"))


def space_summary(name: str) -> str:
    """The options that a space varies, in one line, as far as it holds them."""
    return shorten(", ".join(entry.name for entry in load_space(name)), 85, placeholder=" ...")


def load_space(name: str) -> Space:
    """A space by its name, or from a file.

    Args:
        name: of ``space_names()``, or the path of a YAML file with a mapping of options by name:
            ``learning_rate: {kind: log_float, low: 1e-4, high: 1e-2}``, or
            ``hidden: {kind: choice, values: [64, 128]}``.

    Raises:
        ValueError: there is no such space, or what the file holds is none; one line that names what is wrong.
        OSError: the file cannot be read.

    Example:
        >>> next(iter(load_space("ddpg")))
        Entry(name='learning_rate', kind='log_float', low=0.0002, high=0.005, values=())
    """
    path = Path(name) if name.endswith((".yaml", ".yml")) else _SPACES / f"{name}.yaml"
    if not path.is_file():
        raise ValueError(f"there is no space {name!r}{what_there_is(name, space_names(), 'spaces')}")
    return make_space(str(path) if path.parent != _SPACES else name, read_yaml(path))


def make_space(name: str, values: Any) -> Space:
    """A space from what a file of it holds.

    Raises:
        ValueError: it is no space.
    """
    if not isinstance(values, Mapping) or not all(isinstance(own, str) for own in values):
        raise ValueError(f"the space {name} must hold options by name, got {_repr.repr(values)}")
    return Space(name=name, entries=tuple(_entry(own, each) for own, each in values.items()))


def _entry(name: str, values: Any) -> Entry:
    known = ("kind", "low", "high", "values")
    if not isinstance(values, Mapping) or "kind" not in values:
        raise ValueError(
            f"{name} of a space must have a kind, as in {{kind: float, low: 0, high: 1}}, "
            f"got {_repr.repr(values)}"
        )
    for own in values:
        if own not in known:
            raise ValueError(f"{name} of a space has no {_repr.repr(own)}; it has {', '.join(known)}")
    if not isinstance(values.get("values", []), list):
        raise ValueError(f"values of {name} must be a list, got {_repr.repr(values['values'])}")
    kind: Any = values["kind"]
    ends = {end: values.get(end) for end in ("low", "high")}
    return Entry(name=name, kind=kind, values=tuple(values.get("values", ())), **ends)


def space_for(recipe: Recipe) -> Space:
    """The space of a recipe's learner, without options that have no effect.

    Raises:
        ValueError: the learner has none.
    """
    actions = get_task_spec(recipe.task.name).actions or "continuous"
    learner = BY_ACTIONS[actions] if recipe.learner.name == "auto" else recipe.learner.name
    if learner not in space_names():
        known = ", ".join(space_names())
        raise ValueError(f"learner={learner} has no space of its own ({known} have): give one, --space FILE")
    return load_space(learner).with_effect(recipe)
