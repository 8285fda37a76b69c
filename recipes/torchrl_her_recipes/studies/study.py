"""Runs a study: each combination as batched runs, on all cores or a cluster, and draws its figure."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from torchrl_her_recipes.components.first_look import resolved
from torchrl_her_recipes.config.imports import check_permitted
from torchrl_her_recipes.config.study import Study, curve_label
from torchrl_her_recipes.runs.plots import plot_comparison
from torchrl_her_recipes.runs.run import last_success
from torchrl_her_recipes.studies.plan import Plan
from torchrl_her_recipes.studies.schedule import run_planned
from torchrl_her_recipes.studies.seed_batches import Batches, plan_batches
from torchrl_her_recipes.studies.sweep import SweepResult
from torchrl_her_recipes.studies.workers_local import Workers


@dataclass(frozen=True, kw_only=True)
class StudyResult(SweepResult):
    """What came of a study; ``successes`` are of each combination, if all runs are done.

    Attributes:
        figure: the picture, if all runs are done.
    """

    figure: Path | None


def plan_study(study: Study, folder: Path) -> Plan:
    """What there is to do, and about how long it takes.

    Args:
        study: what to run.
        folder: a folder of each combination goes into it, or is there already. Seeds that it lacks are
            added to those that it has.

    Raises:
        ValueError: the folder has a run of other options under the same name.
    """
    cells = ((label, resolved(recipe)) for label, recipe in study.cells())
    return Plan(job for label, recipe in cells for job in plan_batches(label, recipe, folder))


def run_study(
    study: Study,
    folder: Path,
    *,
    workers: Workers | None = None,
    progress: bool = True,
) -> StudyResult:
    """Runs what is not done yet, several at once, and draws the figure.

    A combination that was interrupted goes on from its checkpoint.

    Args:
        study: what to run.
        folder: a folder of each combination goes into it.
        workers: who does it; by default a process for each core. They are closed in the end.
        progress: whether to show a progress bar over all of it.

    Raises:
        ValueError: the folder has a run of other options under the same name, somebody is at work in it, or
            a task names a module that must not be imported.
        KeyboardInterrupt: by a second Ctrl-C.
    """
    for _, recipe in study.cells():
        check_permitted(recipe.task.name)
    plan, came = run_planned(lambda: plan_study(study, folder), folder, "study", workers, progress=progress)
    done = not plan.to_go
    cells = [label for label, _ in study.cells()] if done else []
    return StudyResult(
        figure=draw_study(study, folder) if done else None,
        successes={label: last_success(Batches(folder / label).rows()) for label in cells},
        **came,
    )


def draw_study(study: Study, folder: Path) -> Path:
    """Metrics over environment steps: a panel for each task, a curve for each combination of the rest."""
    path = folder / f"{study.name}.png"
    panels: dict[str, dict[str, list[dict[str, float]]]] = {}
    for label, recipe in study.cells():
        panels.setdefault(recipe.task.name, {})[curve_label(label, recipe)] = Batches(folder / label).rows()
    plot_comparison(panels, path, metrics=study.figure)
    return path
