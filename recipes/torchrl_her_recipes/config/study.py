"""Definition of studies, which compare combinations of options with several seeds, and their loading."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import product
from typing import Any

from torchrl_her_recipes.config.imports import permit_task
from torchrl_her_recipes.config.metrics import AXES
from torchrl_her_recipes.config.plain_files import naming, read_mapping
from torchrl_her_recipes.config.presets import load_preset
from torchrl_her_recipes.config.recipe import Recipe, compose
from torchrl_her_recipes.config.shipped import find_file, shipped_names
from torchrl_her_recipes.config.shortcuts import locate, merge, place, split_name

_LENGTHS = ("num_runs", "epochs", "epoch_frames", "frames")
_QUICK: dict[str, Any] = {
    "num_runs": 2,
    "epochs": 2,
    "frames": None,
    "epoch_frames": 3_200,
    "num_envs": 16,
    "episodes": 20,
}


@dataclass(frozen=True)
class Order:
    """Expectation that one combination of a study ends with a greater value of a metric than another.

    Attributes:
        measure: Metric that is compared.
        more, less: Combinations that are expected to have the greater and the lesser value.
        text: The comparison as it is written in the study.
    """

    measure: str
    more: str
    less: str
    text: str

    @classmethod
    def parse(cls, measure: str, text: str) -> Order:
        """Parses a comparison of two combinations, written ``a > b`` or ``a < b``.

        Example:
            >>> order = Order.parse("kl", "her_ibs < her")
            >>> order.more, order.less
            ('her', 'her_ibs')
        """
        words = text.split() if isinstance(text, str) else []
        if len(words) != 3 or words[1] not in "<>":
            raise ValueError(f"an order is written 'a > b' or 'a < b', got {text!r}")
        more, less = (words[0], words[2]) if words[1] == ">" else (words[2], words[0])
        return cls(measure, more, less, text)


def read_orders(expect: Mapping[str, Sequence[str]]) -> list[Order]:
    """Parses a study's ``expect``, which maps metrics to lists of comparisons.

    Example:
        >>> [order.more for order in read_orders({"success": ["cher > her"]})]
        ['cher']
    """
    if not isinstance(expect, Mapping) or not all(
        isinstance(orders, list | tuple) for orders in expect.values()
    ):
        raise ValueError(
            "expect must map metrics to lists of comparisons, as in {success: [cher > her]}; "
            f"got {expect!r}"
        )
    return [Order.parse(measure, text) for measure, orders in expect.items() for text in orders]


@dataclass(frozen=True, kw_only=True)
class Study:
    """A study: a comparison of combinations of options, each trained with several seeds.

    Args:
        name: name of the study.
        summary: subject of the comparison, in one line.
        recipe: options that all runs have in common; ``num_runs`` is the number of seeds.
        vary: list of values to compare for each option, by the option's name. All combinations are trained.
            The figure has a panel for each task, with a curve for each combination of the other options.
        cases: sets of further options to compare, by names that you choose; an ablation has a case for each
            part that it removes. Each case is combined with all values in ``vary``, but not with other
            cases. Cases must not set the number or the length of runs, and each of their options must have
            an effect in all combinations of ``vary``.
        for_task: options of the runs on one task only, by the task's name.
        figure: the metrics that are drawn over environment steps.
        expect: expected results, as lists of comparisons ``a > b`` or ``a < b`` of two combinations, by
            metric. The report states for each task whether they hold at the end of training.
        published: results of other authors, which the report shows beside the study's: ``numbers`` by
            metric, task and algorithm, and ``where`` and ``notes`` by metric.

    Raises:
        ValueError: there is nothing to compare, the values of an option are not a list, ``for_task`` names a
            task that is not compared, a case or task sets an option in ``vary``, or a metric is unknown.
    """

    name: str
    summary: str = ""
    recipe: dict[str, Any] = field(default_factory=dict)
    vary: dict[str, Sequence[Any]] = field(default_factory=dict)
    cases: dict[str, dict[str, Any]] = field(default_factory=dict)
    for_task: dict[str, dict[str, Any]] = field(default_factory=dict)
    figure: str | Sequence[str] = ("success",)
    expect: dict[str, Sequence[str]] = field(default_factory=dict)
    published: dict[str, dict[str, Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not isinstance(self.recipe, Mapping):
            raise ValueError(f"recipe of {self.name} must hold names and values, got {self.recipe!r}")
        wrong = not isinstance(self.vary, Mapping) or not (self.vary or self.cases)
        if wrong or not all(isinstance(values, list | tuple) and values for values in self.vary.values()):
            raise ValueError(f"vary of {self.name} must hold lists of values by option, got {self.vary!r}")
        if strange := [name for name in (*self.recipe, *self.vary) if not isinstance(name, str)]:
            raise ValueError(f"options of {self.name} must be names, got {strange[0]!r}")
        tasks = [_task_of(task) for task in self.vary.get("task", ())]
        by = f"by one of the tasks that vary ({', '.join(map(str, tasks)) or 'none'})"
        self._check_sets("for_task", by, lambda task: task in tasks)
        self._check_sets("cases", "by name, such as no_filter", re.compile(r"\w[\w.=+-]*").fullmatch)
        for case, options in self.cases.items():
            if long := _set_in(options, _LENGTHS):
                raise ValueError(f"cases of {self.name} set {long[0]} in {case}: it must not differ by case")
        drawn = [self.figure] if isinstance(self.figure, str) else list(self.figure)
        if not drawn or not set(drawn) <= set(AXES):
            known = ", ".join(AXES)
            raise ValueError(f"figure of {self.name} must be some of {known}; got {self.figure!r}")
        object.__setattr__(self, "figure", drawn)
        read_orders(self.expect)  # raises if an order is not valid

    def _check_sets(self, field: str, by: str, is_name: Callable[[str], object]) -> None:
        """Checks the field ``cases`` or ``for_task``, which must not set options that are in ``vary``."""
        sets = getattr(self, field)
        if not isinstance(sets, Mapping) or not all(
            isinstance(name, str) and is_name(name) and isinstance(entry, Mapping)
            for name, entry in sets.items()
        ):
            raise ValueError(f"{field} of {self.name} must hold options {by}; got {sets!r}")
        for name, options in sets.items():
            if both := _set_in(options, self.vary):
                raise ValueError(f"{field} of {self.name} must not set {both[0]} in {name}, since it varies")

    def combinations(self) -> Iterator[dict[str, Any]]:
        """Yields each combination: values of the options that vary, and a case's name if there are any."""
        axes = {**self.vary, "case": self.cases} if self.cases else self.vary
        for values in product(*axes.values()):
            yield dict(zip(axes, values, strict=True))

    def cells(self) -> Iterator[tuple[str, Recipe]]:
        """Yields the name and the recipe of each combination; the recipe trains all seeds.

        Raises:
            ValueError: a recipe is invalid, two combinations have the same name or the same recipe, or a
                case sets an option that has no effect in one of its combinations.
        """
        before: dict[str, Recipe] = {}
        for combination in self.combinations():
            case = combination.pop("case", "")
            words = [_word(name, value, self.vary[name]) for name, value in combination.items()]
            label = "_".join(word for word in (*words, case) if word).replace("/", "_") or self.name
            if label in before:
                raise ValueError(f"the study {self.name} has two combinations that are called {label}")
            for_task = self.for_task.get(_task_of(combination.get("task")), {})
            # Options without effect are dropped from the shared recipe, but raise an error elsewhere.
            asked = merge(self.cases.get(case, {}), combination)
            try:
                recipe = compose(merge(self.recipe, for_task), asked)
            except ValueError as error:
                raise ValueError(f"{label}: {error}") from error
            if twin := next((other for other, same in before.items() if same == recipe), None):
                raise ValueError(f"the study {self.name} has the same run twice: {twin} and {label}")
            before[label] = recipe
            yield label, recipe


def curve_label(label: str, recipe: Recipe) -> str:
    """Returns the name of a combination without its task, for the legend of the task's panel.

    Example:
        >>> curve_label("hand_v1_her", compose(None, {"task": "hand_v1", "algo": "her"}))
        'her'
    """
    return (
        f"_{label}_".replace(f"_{recipe.task.name.replace('/', '_')}_", "_").strip("_")
        or recipe.hindsight.algo
    )


def _word(name: str, value: Any, values: Sequence[Any]) -> str:
    """Names a varied option's value in a combination (``tau=0.05``); for mappings, the differing entries."""
    if all(isinstance(each, Mapping) for each in values):
        entries = {key: [each.get(key) for each in values] for key in value}
        differing = {
            key: column for key, column in entries.items() if any(other != column[0] for other in column)
        }
        return "_".join(_word(key, value[key], column) for key, column in differing.items())
    if isinstance(value, Mapping):
        return "_".join(_word(name, entry, [None]) for entry in value.values())
    short = name.rpartition(".")[2]
    return str(value) if short in ("task", "algo") else f"{short}={value}"


def study_names() -> list[str]:
    """Returns the names of all studies that come with the package."""
    return shipped_names("study")


def load_study(
    name: str, *, seeds: int | None = None, frames: int | None = None, quick: bool = False
) -> Study:
    """Loads a study that comes with the package, or one from a YAML file.

    Args:
        name: one of :func:`study_names`, or the path of a .yaml file.
        seeds: number of seeds of each combination, in place of the study's own number.
        frames: environment steps of each run, rounded up to whole epochs; None for the study's own number.
        quick: whether to shrink the study so that it ends in minutes.

    Raises:
        ValueError: there is no such study, its file is invalid, or a number is below 1.
    """
    path = find_file("study", name)
    values = read_mapping(path)
    preset = values.pop("preset", None)
    known = [field.name for field in fields(Study) if field.name != "name"]
    if unknown := [key for key in values if key not in known]:
        raise ValueError(f"{path}: unknown {', '.join(unknown)}; a study has preset, {', '.join(known)}")
    sizes = {"num_runs": seeds, "frames": frames}
    asked = merge(_QUICK if quick else {}, {name: size for name, size in sizes.items() if size is not None})
    with naming(path):
        study = Study(name=path.stem, **values)
        if not study.name.strip("."):
            raise ValueError("a study is named after its file, which must have a name before its suffix")
        shared = merge(load_preset(preset) if preset else {}, study.recipe, asked)
        for_task = {task: merge(options, asked) for task, options in study.for_task.items()}
        study = replace(study, recipe=shared, for_task=for_task)
        cells = list(study.cells())  # raises if a combination is not valid
        combined = dict.fromkeys(curve_label(label, recipe) for label, recipe in cells)
        named = (name for order in read_orders(study.expect) for name in (order.more, order.less))
        if strange := next((name for name in named if name not in combined), None):
            labels = ", ".join(combined)
            raise ValueError(f"expect must name combinations, which are {labels}; got {strange!r}")
    if name in study_names():  # studies of the package are trusted, so the modules of their tasks are, too
        for _, recipe in cells:
            permit_task(recipe.task.name)
    return study


def _set_in(options: Mapping[str, Any], names: Iterable[str]) -> list[str]:
    """Returns those of the names of options, or of entries such as ``task.options.bits``, that are set."""
    placed = place(options)

    def is_set(option: str, *entry: str) -> bool:
        group, key = locate(option)
        values = placed.get(group, {})
        return key in values and all(name in (values[key] or {}) for name in entry)

    return [name for name in names if is_set(*split_name(name))]


def _task_of(task: Any) -> Any:
    """Returns the name of a task, which is given as its name or as a mapping of task options."""
    return task.get("name") if isinstance(task, Mapping) else task
