"""What there is of a study: its combinations, how far each of them is, and what its runs reached."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from torchrl_her_recipes.batches import Batches
from torchrl_her_recipes.recipe import Recipe
from torchrl_her_recipes.studies import Study, curve_label

LAST = 3  # evaluations whose mean is what a run reached in the end


@dataclass(frozen=True, kw_only=True)
class Combination:
    """One combination of a study, and what there is of its runs so far.

    Attributes:
        label: its folder's name.
        task: what was learnt.
        algorithm: what sets it apart from the others on the same task.
        batches: what its folder holds.
        recipe: what was run; if nothing was, what is to be run.
        rows: its table of metrics, one row an epoch and run.
        done: whether the runs in its table are at their end.
        planned: how many runs the study has of it.
        differs: options that are not the study's, in words.
    """

    label: str
    task: str
    algorithm: str
    batches: Batches
    recipe: Recipe
    rows: list[dict[str, float]]
    done: bool
    planned: int
    differs: str

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
            return f"at epoch {self.epoch} of {self.recipe.epochs}"
        return "at its end" if self.whole else f"at its end with {self.runs} of {self.planned} runs"

    @property
    def whole(self) -> bool:
        """Whether it is at its end with all of the study's runs."""
        return self.done and self.runs >= self.planned

    @property
    def seconds(self) -> float:
        """How long its runs took, one core each."""
        return self.batches.seconds

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
    cells = [_read(label, recipe, Batches(folder / label)) for label, recipe in study.cells()]
    if all(cell.missing for cell in cells):
        labels = ", ".join(cell.label for cell in cells)
        raise ValueError(f"{folder} has no run of the study {study.name}; its runs are {labels}")
    return cells


def _read(label: str, planned: Recipe, batches: Batches) -> Combination:
    made = batches.recipe or planned
    ours, study_s = asdict(made), asdict(planned)
    differs = [
        f"{name}={value} (the study: {study_s[name]})"
        for name, value in ours.items()
        if value != study_s[name]
    ]
    return Combination(
        label=label,
        task=planned.task,
        algorithm=curve_label(label, planned),
        batches=batches,
        recipe=made,
        rows=batches.rows(),
        done=batches.is_done,
        planned=planned.num_runs,
        differs=", ".join(differs),
    )


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
