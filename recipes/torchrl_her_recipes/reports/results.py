"""The class :class:`Combination`, the results of one combination of a study, and functions that read them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchrl_her_recipes.config.recipe import Recipe
from torchrl_her_recipes.config.study import Study, curve_label
from torchrl_her_recipes.runs.goal_map import GoalMap
from torchrl_her_recipes.studies.seed_batches import Batches


@dataclass(frozen=True, kw_only=True)
class Combination:
    """Results so far of the runs of one combination in a study.

    All values are plain, so that they can be read from folders of runs or from files of results.

    Attributes:
        label: name of the combination and of its folder.
        task: name of the task.
        algorithm: name that distinguishes the combination from others on the same task.
        options: the options that the study varies, with their values in this combination.
        rows: table of metrics, one row for each epoch and run.
        done: whether the runs in the table have reached their last epoch.
        epochs: number of epochs of a finished run.
        planned: number of runs that the study plans for the combination.
        seconds: total duration of the runs, each batch of runs on one core; NaN if it is unknown.
        differs: options of the runs that differ from the study's, as text.
        goals: histogram of virtual goals; None if they were not counted.
    """

    label: str
    task: str
    algorithm: str
    options: Mapping[str, Any]
    rows: list[dict[str, float]]
    done: bool
    epochs: int
    planned: int
    seconds: float
    differs: str
    goals: GoalMap | None

    @property
    def missing(self) -> bool:
        """Whether there are no results yet."""
        return not self.rows

    @property
    def epoch(self) -> int:
        """The last epoch that was evaluated; 0 if there was none."""
        return int(self.rows[-1]["epoch"]) if self.rows else 0

    @property
    def frames(self) -> int:
        """Number of environment steps of each run so far."""
        return int(self.rows[-1]["frames"]) if self.rows else 0

    @property
    def runs(self) -> int:
        """Number of runs in the table."""
        return len({row["run"] for row in self.rows})

    @property
    def state(self) -> str:
        """Progress of the combination, in words."""
        if self.missing:
            return "missing"
        if not self.done:
            return f"at epoch {self.epoch} of {self.epochs}"
        return "at its end" if self.whole else f"at its end with {self.runs} of {self.planned} runs"

    @property
    def whole(self) -> bool:
        """Whether all runs that the study plans for the combination are finished."""
        return self.done and self.runs >= self.planned

    def has(self, name: str) -> bool:
        """Returns whether all rows of the table have a metric."""
        return bool(self.rows) and all(name in row for row in self.rows)


def read_combinations(study: Study, folder: Path) -> list[Combination]:
    """Reads the results of all combinations of a study from the folder in which it was run."""
    if not folder.is_dir():
        raise ValueError(f"there is no folder {folder}; `torchrl-her study {study.name}` makes its runs")
    cells = []
    for options, (label, planned) in zip(study.combinations(), study.cells(), strict=True):
        batches = Batches(folder / label)
        differences = _differences(batches.recipe or planned, planned)
        differs = [f"{name}={value} (the study: {usual})" for name, value, usual in differences]
        algorithm = curve_label(label, planned)
        cells.append(_combination(label, algorithm, planned, batches, differs=differs, options=options))
    if all(cell.missing for cell in cells):
        labels = ", ".join(cell.label for cell in cells)
        raise ValueError(f"{folder} has no run of the study {study.name}; its runs are {labels}")
    return cells


def read_single(label: str, batches: Batches) -> Combination:
    """Reads runs outside of a study, which differ only in seeds, as a combination that is named ``label``."""
    recipes = [home.recipe() for home in batches.homes]
    planned = recipes[0].replace(num_runs=sum(recipe.run.num_runs for recipe in recipes))
    differs = [f"{name}={value}" for name, value, _ in _differences(planned, Recipe())]
    return _combination(label, label, planned, batches, differs=differs, options={})


def _combination(
    label: str,
    algorithm: str,
    planned: Recipe,
    batches: Batches,
    *,
    differs: list[str],
    options: Mapping[str, Any],
) -> Combination:
    rows = batches.rows()
    return Combination(
        label=label,
        task=planned.task.name,
        algorithm=algorithm,
        options=dict(_flat(options)),
        rows=rows,
        done=batches.is_done,
        epochs=(batches.recipe or planned).run.epochs,
        planned=planned.run.num_runs,
        seconds=batches.seconds if rows else 0.0,
        differs=", ".join(differs),
        goals=batches.goal_map(),
    )


def _differences(used: Recipe, usual: Recipe) -> list[tuple[str, Any, Any]]:
    """Returns the options in which two recipes differ: (name, value in ``used``, value in ``usual``)."""
    left, right = dict(_flat(used.to_dict())), dict(_flat(usual.to_dict()))
    changed = {*dict(_flat(used.changed())), *dict(_flat(usual.changed()))}
    differ = [name for name, value in left.items() if name in changed and value != right.get(name)]
    return [(name, left[name], right.get(name)) for name in differ]


def _flat(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yields the values in nested mappings, with names such as ``group.option``."""
    for name, value in values.items():
        if isinstance(value, Mapping) and value:
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield prefix + str(name), value
