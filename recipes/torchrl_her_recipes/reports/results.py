"""What there is of a study: its combinations, how far each of them is, and what its runs reached."""

from __future__ import annotations

import statistics
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from torchrl_her_recipes.config.recipe import Recipe
from torchrl_her_recipes.config.study import Study, curve_label
from torchrl_her_recipes.runs.goal_map import GoalMap
from torchrl_her_recipes.studies.seed_batches import Batches

LAST = 3  # evaluations whose mean is what a run reached in the end


@dataclass(frozen=True, kw_only=True)
class Combination:
    """One combination of a study, and what there is of its runs so far.

    It holds plain values, so that it can come from the folders of runs as well as from files of results.

    Attributes:
        label: its name, which is that of its folder.
        task: the task that was learned.
        algorithm: what sets it apart from the others on the same task.
        options: the options that the study varies, and their values here.
        rows: its table of metrics, one row for each epoch and run.
        done: whether the runs in its table have reached their last epoch.
        epochs: the last epoch of its runs.
        planned: how many runs the study has of it.
        seconds: how long its runs took, one core each; NaN if that is not known.
        differs: options that are not the study's, in words.
        goals: where its virtual goals lie; None if nothing counted them.
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
        """Whether there is nothing to show of it."""
        return not self.rows

    @property
    def epoch(self) -> int:
        """The last one that was evaluated."""
        return int(self.rows[-1]["epoch"]) if self.rows else 0

    @property
    def frames(self) -> int:
        """Environment steps of each run so far."""
        return int(self.rows[-1]["frames"]) if self.rows else 0

    @property
    def runs(self) -> int:
        """How many runs are in the table."""
        return len({row["run"] for row in self.rows})

    @property
    def state(self) -> str:
        """How far it is, in words."""
        if self.missing:
            return "missing"
        if not self.done:
            return f"at epoch {self.epoch} of {self.epochs}"
        return "at its end" if self.whole else f"at its end with {self.runs} of {self.planned} runs"

    @property
    def whole(self) -> bool:
        """Whether it is at its end with all of the study's runs."""
        return self.done and self.runs >= self.planned

    def has(self, name: str) -> bool:
        """Whether its table has a metric."""
        return bool(self.rows) and all(name in row for row in self.rows)


def read_combinations(study: Study, folder: Path) -> list[Combination]:
    """All combinations of a study, with what a folder holds of them.

    Args:
        study: what was to be run.
        folder: with a folder of each combination.

    Raises:
        ValueError: there is no such folder, it has none of the study's runs, or one cannot be read.
    """
    if not folder.is_dir():
        raise ValueError(f"there is no folder {folder}; `torchrl-her study {study.name}` makes its runs")
    cells = [
        _read(label, recipe, options, Batches(folder / label))
        for options, (label, recipe) in zip(study.combinations(), study.cells(), strict=True)
    ]
    if all(cell.missing for cell in cells):
        labels = ", ".join(cell.label for cell in cells)
        raise ValueError(f"{folder} has no run of the study {study.name}; its runs are {labels}")
    return cells


def _read(label: str, planned: Recipe, options: Mapping[str, Any], batches: Batches) -> Combination:
    """The only place of reports that reads a recipe."""
    made = batches.recipe or planned
    ours, study_s = dict(_flat(asdict(made))), dict(_flat(asdict(planned)))
    differs = [
        f"{name}={value} (the study: {study_s.get(name)})"
        for name, value in ours.items()
        if value != study_s.get(name)
    ]
    rows = batches.rows()
    return Combination(
        label=label,
        task=planned.task.name,
        algorithm=curve_label(label, planned),
        options=dict(_flat(options)),
        rows=rows,
        done=batches.is_done,
        epochs=made.run.epochs,
        planned=planned.run.num_runs,
        seconds=batches.seconds if rows else 0.0,
        differs=", ".join(differs),
        goals=batches.goal_map(),
    )


def _flat(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Mappings within mappings as one, with names such as ``group.option``."""
    for name, value in values.items():
        if isinstance(value, Mapping) and value:
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield prefix + str(name), value


def at_the_end(rows: Sequence[dict[str, float]], name: str, *, evaluations: int = LAST) -> list[float]:
    """One metric of each run: the mean of its last evaluations.

    Args:
        rows: the table of metrics, one row an epoch and run.
        name: of the metric.
        evaluations: how many.

    Returns:
        One number for each run, in the order of the runs.

    Example:
        >>> rows = [{"run": 0, "success": success} for success in (0.0, 0.5, 0.75, 1.0)]
        >>> at_the_end(rows, "success")
        [0.75]
    """
    runs: dict[float, list[float]] = {}
    for row in rows:
        runs.setdefault(row["run"], []).append(row[name])
    return [statistics.fmean(values[-evaluations:]) for _, values in sorted(runs.items())]
