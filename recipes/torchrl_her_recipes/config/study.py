"""Studies: which combinations of options are compared, each with several seeds, and in which figure."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import product
from pathlib import Path
from typing import Any

from torchrl_her_recipes.config.metrics import metric_names
from torchrl_her_recipes.config.options import what_there_is
from torchrl_her_recipes.config.recipe import Recipe, compose
from torchrl_her_recipes.config.shipped import CONF, load_preset
from torchrl_her_recipes.config.shortcuts import locate, merge, place
from torchrl_her_recipes.config.values import read_mapping

_STUDIES = CONF / "study"
_QUICK: dict[str, Any] = {
    "num_runs": 2,
    "epochs": 2,
    "epoch_frames": 3_200,
    "num_envs": 16,
    "episodes": 20,
}


@dataclass(frozen=True, kw_only=True)
class Study:
    """A comparison of recipes.

    Args:
        name: of the study.
        summary: what it compares, in one line.
        recipe: options that all runs have in common; ``num_runs`` is the number of seeds.
        vary: the values that are compared, by the name of their option. All combinations are run. The
            figure has a panel for each task, and in it a curve for each combination of the others.
        for_task: options of the runs on some of the tasks alone, by the task's name.
        figure: the metrics that are drawn over environment steps, or "times" for the steps until the
            task ``chain`` is solved.

    Raises:
        ValueError: there is nothing to compare, the values of an option are no list, there are options for a
            task that is not compared, or a metric is unknown.
    """

    name: str
    summary: str = ""
    recipe: dict[str, Any] = field(default_factory=dict)
    vary: dict[str, Sequence[Any]] = field(default_factory=dict)
    for_task: dict[str, dict[str, Any]] = field(default_factory=dict)
    figure: str | Sequence[str] = ("success",)

    def __post_init__(self) -> None:
        if not isinstance(self.recipe, Mapping):
            raise ValueError(f"recipe of {self.name} must hold names and values, got {self.recipe!r}")
        wrong = not isinstance(self.vary, Mapping) or not self.vary
        if wrong or not all(isinstance(values, list | tuple) and values for values in self.vary.values()):
            raise ValueError(f"vary of {self.name} must hold lists of values by option, got {self.vary!r}")
        if strange := [name for name in (*self.recipe, *self.vary) if not isinstance(name, str)]:
            raise ValueError(f"options of {self.name} must be names, got {strange[0]!r}")
        tasks = [_task_of(task) for task in self.vary.get("task", ())]
        if not isinstance(self.for_task, Mapping) or not all(
            task in tasks and isinstance(own, Mapping) for task, own in self.for_task.items()
        ):
            raise ValueError(
                f"for_task of {self.name} must hold options by one of the tasks that vary "
                f"({', '.join(map(str, tasks)) or 'none'}), got {self.for_task!r}"
            )
        varied = {locate(name) for name in self.vary}
        for task, own in self.for_task.items():
            both = [name for group, names in place(own).items() for name in names if (group, name) in varied]
            if both:
                raise ValueError(f"for_task of {self.name} sets {both[0]} for {task}, which varies")
        drawn = [self.figure] if isinstance(self.figure, str) else list(self.figure)
        if drawn != ["times"] and (not drawn or not set(drawn) <= set(metric_names())):
            known = ", ".join(metric_names())
            raise ValueError(f"figure of {self.name} must be times, or some of {known}; got {self.figure!r}")
        object.__setattr__(self, "figure", "times" if drawn == ["times"] else drawn)

    def cells(self) -> Iterator[tuple[str, Recipe]]:
        """The names and recipes of all combinations; the runs of a recipe are its seeds.

        Raises:
            ValueError: a recipe cannot work, or two combinations have the same name.
        """
        labels = set()
        for values in product(*self.vary.values()):
            own = dict(zip(self.vary, values, strict=True))
            words = (_word(name, value, self.vary[name]) for name, value in own.items())
            label = "_".join(word for word in words if word).replace("/", "_") or self.name
            if label in labels:
                raise ValueError(f"the study {self.name} has two combinations that are called {label}")
            labels.add(label)
            recipe = compose(merge(self.recipe, self.for_task.get(_task_of(own.get("task")), {})), own)
            if self.figure == "times" and recipe.task.name != "chain":
                task = recipe.task.name
                raise ValueError(f"the figure times of {self.name} is for the task chain, not {task}")
            yield label, recipe


def curve_label(label: str, recipe: Recipe) -> str:
    """The name of a combination without its task, as in the legend of a panel.

    Example:
        >>> curve_label("hand_v1_her", compose(None, {"task": "hand_v1", "algo": "her"}))
        'her'
    """
    return (
        f"_{label}_".replace(f"_{recipe.task.name.replace('/', '_')}_", "_").strip("_")
        or recipe.hindsight.algo
    )


def _word(name: str, value: Any, values: Sequence[Any]) -> str:
    """The part of a name for one of the ``values`` of an option; of mappings, the entries that differ."""
    if all(isinstance(each, Mapping) for each in values):
        entries = {key: [each.get(key) for each in values] for key in value}
        differing = {key: own for key, own in entries.items() if any(other != own[0] for other in own)}
        return "_".join(_word(key, value[key], own) for key, own in differing.items())
    short = name.rpartition(".")[2]
    return str(value) if short in ("task", "algo") else f"{short}={value}"


def study_names() -> list[str]:
    """All studies that come with the package."""
    return sorted(path.stem for path in _STUDIES.glob("*.yaml"))


def load_study(
    name: str, *, seeds: int | None = None, frames: int | None = None, quick: bool = False
) -> Study:
    """A study that comes with the package, or one from a YAML file.

    Args:
        name: one of :func:`study_names`, or the path of a .yaml file.
        seeds: runs of each combination, in place of the study's own number.
        frames: environment steps of each run, rounded up to whole epochs.
        quick: whether to shrink it so that it ends in minutes.

    Raises:
        ValueError: there is no such study, or a number below 1.
    """
    path = Path(name) if name.endswith((".yaml", ".yml")) else _STUDIES / f"{name}.yaml"
    if not path.is_file():
        raise ValueError(f"there is no study {name!r}{what_there_is(name, study_names(), 'studies')}")
    for option, value in (("seeds", seeds), ("frames", frames)):
        if value is not None and value < 1:
            raise ValueError(f"{option} must be at least 1, got {value}")
    values = read_mapping(path)
    preset = values.pop("preset", None)
    known = [field.name for field in fields(Study) if field.name != "name"]
    if unknown := [key for key in values if key not in known]:
        raise ValueError(f"{path}: a study has no {', '.join(unknown)}; it has preset, {', '.join(known)}")
    study = Study(name=path.stem, **values)
    recipe = merge(load_preset(preset) if preset else {}, study.recipe)
    asked = merge(_QUICK if quick else {}, {} if seeds is None else {"num_runs": seeds})

    def shortened(own: Mapping[str, Any]) -> dict[str, Any]:
        """Options with those that were asked for, and as many epochs as hold the frames."""
        if frames is None:
            return merge(own, asked)
        first = {name: values[0] for name, values in study.vary.items()}
        epoch_frames = compose(merge(recipe, own, asked), first).collection.epoch_frames
        return merge(own, asked, {"epochs": -(-frames // epoch_frames)})

    for_task = {task: shortened(own) for task, own in study.for_task.items()}
    return replace(study, recipe=merge(recipe, shortened({})), for_task=for_task)


def _task_of(task: Any) -> Any:
    """The name of a task that varies, which may be given with its options."""
    return task.get("name") if isinstance(task, Mapping) else task
