"""Search spaces: the options that a search varies, and their ranges."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from textwrap import shorten
from typing import TYPE_CHECKING, Any

from torchrl_her_envs.registry import get_task_spec
from torchrl_her_recipes.config.choices.learners import BY_ACTIONS
from torchrl_her_recipes.config.plain_files import read_yaml, shown
from torchrl_her_recipes.config.recipe import Recipe, compose, drop_alternatives
from torchrl_her_recipes.config.shipped import find_file, shipped_names
from torchrl_her_recipes.config.shortcuts import locate, over, place, short_name, split_name
from torchrl_her_recipes.config.values import as_kind
from torchrl_her_recipes.config.without_effect import without_effect

if TYPE_CHECKING:
    from optuna.distributions import BaseDistribution

_RANGE = ("low", "high")
_KINDS = {"float": _RANGE, "log_float": _RANGE, "int": _RANGE, "log_int": _RANGE, "choice": ("values",)}
_MOST = 100  # largest number of values in a range of kind "choice"
_LARGEST = 1e15
# Options that cannot vary: trials must have the same length and start to be compared.
_SAME_FOR_ALL = (
    "task",
    "seed",
    "num_runs",
    "epochs",
    "frames",
    "epoch_frames",
    "checkpoint_interval",
    "keep_buffer",
)


@dataclass(frozen=True, kw_only=True)
class Space:
    """Search space: the options that a search varies, and their ranges.

    A space can also be used in a loop over Optuna's own study::

        trial = study.ask(space.distributions())
        study.tell(trial, run_score(space.recipe(recipe, trial.params)))

    Args:
        name: Name of the space in messages.
        ranges: Range of each option, by the option's name (short, or with its group). A range of numbers is
            ``{kind: float, low: 0, high: 1}``, with the kinds ``float``, ``int``, ``log_float`` and
            ``log_int``; other values are ``{kind: choice, values: [relu, tanh]}``.

    Raises:
        ValueError: an option or kind is unknown, a range is empty, or an option has two ranges.
    """

    name: str
    ranges: Mapping[str, Mapping[str, Any]]

    def __post_init__(self) -> None:
        if not isinstance(self.ranges, Mapping) or not all(isinstance(name, str) for name in self.ranges):
            raise ValueError(f"the space {self.name} must hold options by name, got {shown(self.ranges)}")
        if not self.ranges:
            raise ValueError(f"the space {self.name} has no options to vary")
        checked = {name: _checked(name, values) for name, values in self.ranges.items()}
        places = [locate(name) for name in checked]
        for home, name in zip(places, checked, strict=True):
            if places.count(home) > 1:
                raise ValueError(f"the space {self.name} has two entries for {name}")
        object.__setattr__(self, "ranges", checked)

    def distributions(self) -> dict[str, BaseDistribution]:
        """Returns Optuna's distributions by the names of the options, as ``study.ask`` takes them."""
        return {name: _distribution(**values) for name, values in self.ranges.items()}

    def without(self, names: Iterable[str]) -> Space:
        """Returns a copy of the space without the named options.

        Raises:
            ValueError: no option is left.

        Example:
            >>> load_space("dqn").without(["learner.gamma"]).ranges.get("gamma")
        """
        fixed = {locate(split_name(name)[0]) for name in names}
        left = {name: values for name, values in self.ranges.items() if locate(name) not in fixed}
        if not left:
            raise ValueError(f"all options of the space {self.name} are given: there is nothing to search")
        return replace(self, ranges=left)

    def check(self, recipe: Recipe) -> None:
        """Checks that a recipe accepts both ends of each range, and each value of each choice.

        Raises:
            ValueError: the recipe does not accept a value; the message names the option.
        """
        for name, values in self.ranges.items():
            for value in values.get("values") or (values["low"], values["high"]):
                try:
                    recipe.replace(**{name: value})
                except ValueError as error:
                    raise ValueError(f"the space {self.name} does not fit: {error}") from error

    def recipe(self, base: Recipe, values: Mapping[str, Any]) -> Recipe:
        """Returns a copy of ``base`` with the given values of varied options.

        A value that has no effect together with the others is left out. ``k`` and ``strategy`` replace
        the ``goal_sources`` of ``base``.

        Raises:
            ValueError: the values cannot be used together.
        """
        given = place(values, base.to_dict())
        drop_alternatives({}, given)
        return compose(over(base.to_dict(), given), {})

    def values_of(self, recipe: Recipe) -> dict[str, Any]:
        """Returns the values that a recipe has for the varied options, except options without effect."""
        idle = without_effect(recipe)
        places = {name: locate(name, recipe.to_dict()) for name in self.ranges}
        return {
            name: getattr(getattr(recipe, group), option)
            for name, (group, option) in places.items()
            if (group, option) not in idle
        }

    def inside(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Returns the given values that lie inside the ranges of their options.

        Example:
            >>> load_space("ddpg").inside({"gamma": 0.95, "hidden": 100})
            {'gamma': 0.95}
        """
        return {name: value for name, value in values.items() if _includes(self.ranges[name], value)}


def _checked(name: str, values: Any) -> dict[str, Any]:
    """Checks the range of an option and returns it, with text such as ``1e-4`` converted to numbers."""
    if short_name(*locate(name)) in _SAME_FOR_ALL:
        raise ValueError(f"{name} must be the same in all trials of a search: it cannot be varied")
    if not isinstance(values, Mapping) or "kind" not in values:
        example = "{kind: float, low: 0, high: 1}"
        raise ValueError(f"{name} of a space must have a kind, as in {example}, got {shown(values)}")
    kind = values["kind"]
    if kind not in list(_KINDS):
        raise ValueError(f"kind of {name} must be one of {', '.join(_KINDS)}, got {shown(kind)}")
    if set(values) != {"kind", *_KINDS[kind]}:
        raise ValueError(f"{name} of kind {kind} must have {' and '.join(_KINDS[kind])}, got {shown(values)}")
    if kind == "choice":
        return {"kind": kind, "values": _checked_choice(name, values["values"])}
    number = float if kind.endswith("float") else int
    low, high = (as_kind(f"{end} of {name}", values[end], number) for end in _RANGE)
    least = 0.0 if kind.startswith("log") else -_LARGEST
    if not least < low < high < _LARGEST:
        between = f"above {least:g} and below {_LARGEST:g}"
        raise ValueError(f"low of {name} must be below high, and both {between}, got {low} and {high}")
    return {"kind": kind, "low": low, "high": high}


def _checked_choice(name: str, values: Any) -> list[Any]:
    plain = isinstance(values, list) and all(
        value is None or isinstance(value, str | int | float) for value in values
    )
    if not plain or not len(values) == len(set(map(repr, values))) in range(2, _MOST + 1):
        needed = f"a list of 2 to {_MOST} different numbers, texts, true or false"
        raise ValueError(f"values of {name} must be {needed}, got {shown(values)}")
    return list(values)


def _distribution(*, kind: str, low: Any = 0, high: Any = 0, values: Sequence[Any] = ()) -> BaseDistribution:
    from optuna import distributions  # noqa: PLC0415  (imported here, since it is in an extra)

    if kind == "choice":
        return distributions.CategoricalDistribution(values)
    number = distributions.FloatDistribution if kind.endswith("float") else distributions.IntDistribution
    return number(low, high, log=kind.startswith("log"))


def _includes(values: Mapping[str, Any], value: Any) -> bool:
    if values["kind"] == "choice":
        return value in values["values"]
    return isinstance(value, int | float) and values["low"] <= value <= values["high"]


def space_names() -> list[str]:
    """Returns the names of all spaces that come with the package, one for each learner."""
    return shipped_names("space")


def space_summary(name: str) -> str:
    """Returns the names of the options that a space varies, in one line of at most 85 characters."""
    return shorten(", ".join(load_space(name).ranges), 85, placeholder=" ...")


def load_space(name: str) -> Space:
    """Loads a search space by its name, or from a file.

    Args:
        name: one of ``space_names()``, or the path of a YAML file that maps names of options to ranges, as in
            ``learning_rate: {kind: log_float, low: 1e-4, high: 1e-2}`` or
            ``hidden: {kind: choice, values: [64, 128]}``.

    Raises:
        ValueError: no space has this name, or the file does not hold a space; the message is one line.
        OSError: the file cannot be read.

    Example:
        >>> load_space("ddpg").ranges["learning_rate"]
        {'kind': 'log_float', 'low': 0.0002, 'high': 0.005}
    """
    return Space(name=name, ranges=read_yaml(find_file("space", name)))


def space_for(recipe: Recipe) -> Space:
    """Returns the package's search space for a recipe's learner, without options that have no effect.

    Raises:
        ValueError: the package has no search space for the learner.
    """
    actions = get_task_spec(recipe.task.name).actions or "continuous"
    learner = BY_ACTIONS[actions] if recipe.learner.name == "auto" else recipe.learner.name
    if learner not in space_names():
        known = ", ".join(space_names())
        raise ValueError(f"there is a search space for {known}, not for {learner}: give --space FILE")
    return load_space(learner).without(f"{group}.{option}" for group, option in without_effect(recipe))
