"""Runs a study: each combination as batched runs, on all cores or a cluster, and draws its figure."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from filelock import FileLock, Timeout

from torchrl_her_recipes.components.first_look import resolved
from torchrl_her_recipes.config.imports import check_permitted
from torchrl_her_recipes.config.study import Study, curve_label
from torchrl_her_recipes.runs.plots import plot_comparison
from torchrl_her_recipes.runs.run import last_success
from torchrl_her_recipes.studies.plan import Plan
from torchrl_her_recipes.studies.schedule import run_jobs
from torchrl_her_recipes.studies.seed_batches import Batches, plan_batches
from torchrl_her_recipes.studies.workers_local import LocalWorkers, Workers


@dataclass(frozen=True, kw_only=True)
class StudyResult:
    """What came of a study.

    Attributes:
        figure: the picture, if all runs are done.
        interrupted: whether somebody stopped it. It goes on if it is run again.
        failed: why, by the name of the batched run. The others are not held back by it.
        successes: of the runs of each combination in their last evaluation, if all runs are done.
    """

    figure: Path | None
    interrupted: bool = False
    failed: dict[str, str] = field(default_factory=dict)
    successes: dict[str, list[float]] = field(default_factory=dict)


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
    workers = workers or LocalWorkers()
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with FileLock(folder / ".lock", timeout=0):
            plan = plan_study(study, folder)
            outcomes = run_jobs(plan, workers, progress=progress)
    except Timeout as error:
        raise ValueError(f"another process is running a study in {folder}") from error
    finally:
        workers.close()
    done = not plan.to_go
    return StudyResult(
        figure=draw_study(study, folder) if done else None,
        successes={label: last_success(Batches(folder / label).rows()) for label, _ in study.cells()}
        if done
        else {},
        interrupted=any(outcome.interrupted for outcome in outcomes.values()),
        failed={label: outcome.error for label, outcome in outcomes.items() if outcome.error},
    )


def draw_study(study: Study, folder: Path) -> Path:
    """Metrics over environment steps: a panel for each task, a curve for each combination of the rest."""
    path = folder / f"{study.name}.png"
    panels: dict[str, dict[str, list[dict[str, float]]]] = {}
    for label, recipe in study.cells():
        panels.setdefault(recipe.task.name, {})[curve_label(label, recipe)] = Batches(folder / label).rows()
    plot_comparison(panels, path, metrics=study.figure)
    return path
