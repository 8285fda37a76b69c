"""Runs the unfinished jobs of a study or a sweep, on all cores or a cluster, and draws a study's figure."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path

from filelock import FileLock, Timeout

from torchrl_her.files.writing import write_text
from torchrl_her_recipes.components.first_look import resolved
from torchrl_her_recipes.config.imports import check_permitted
from torchrl_her_recipes.config.recipe import Recipe
from torchrl_her_recipes.config.study import Study, curve_label
from torchrl_her_recipes.runs.folder import RunFolder
from torchrl_her_recipes.runs.plots import plot_comparison
from torchrl_her_recipes.runs.scores import last_success
from torchrl_her_recipes.studies.jobs import Job
from torchrl_her_recipes.studies.plan import Plan
from torchrl_her_recipes.studies.schedule import run_jobs
from torchrl_her_recipes.studies.seed_batches import Batches, plan_batches
from torchrl_her_recipes.studies.workers import LocalWorkers, Workers

_NOTE = "sweep.json"  # file with the recipes of all runs of a sweep, by which the sweep is recognized


@dataclass(frozen=True, kw_only=True)
class StudyResult:
    """The result of a study or of a sweep.

    Attributes:
        figure: path of a study's figure; None if runs are unfinished, and for a sweep.
        successes: success of each run in its last evaluation, by the name of its combination or of the run.
            Combinations with unfinished runs are left out.
        failed: reasons of failures, by the label of the job.
        interrupted: whether the user stopped the study, which can be resumed.
    """

    figure: Path | None = None
    successes: dict[str, list[float]] = field(default_factory=dict)
    failed: dict[str, str] = field(default_factory=dict)
    interrupted: bool = False


def plan_study(study: Study | Mapping[str, Recipe], folder: str | Path) -> Plan:
    """Plans the jobs of a study or of a sweep.

    Args:
        study: study to run; or recipes of a sweep's runs, by the names of their folders.
        folder: folder with a folder for each combination or run, which may exist already. If an existing
            combination lacks seeds of the study, jobs are planned for these seeds.

    Raises:
        ValueError: the folder has a run with the same name and other options.
    """
    folder = Path(folder)
    if isinstance(study, Study):
        cells = ((label, resolved(recipe)) for label, recipe in study.cells())
        jobs = [job for label, recipe in cells for job in plan_batches(label, recipe, folder)]
    else:
        jobs = [Job(label=label, recipe=resolved(run), folder=folder / label) for label, run in study.items()]
    return Plan(jobs)


def run_study(
    study: Study | Mapping[str, Recipe],
    folder: str | Path,
    *,
    workers: Workers | None = None,
    progress: bool = True,
) -> StudyResult:
    """Runs the unfinished jobs of a study or of a sweep, several at once, and draws a study's figure.

    Interrupted runs are resumed from their checkpoints.

    Args:
        study: study to run; or recipes of a sweep's runs, by the names of their folders.
        folder: folder in which each combination or run gets a folder.
        workers: workers that run the jobs, by default a process for each core; they are closed at the end.
        progress: whether to show a progress bar for all jobs together.

    Raises:
        ValueError: the folder has a run with the same name and other options, another process is using the
            folder, or a task names a module that must not be imported.
        KeyboardInterrupt: Ctrl-C was pressed a second time.
    """
    folder, runs = Path(folder), dict(study.cells()) if isinstance(study, Study) else study
    for recipe in runs.values():
        check_permitted(recipe.task.name)
    with closing(workers or LocalWorkers()) as workers:
        folder.mkdir(parents=True, exist_ok=True)
        try:
            with FileLock(folder / ".lock", timeout=0):
                plan = plan_study(study, folder)
                if not isinstance(study, Study):
                    write_text(folder / _NOTE, _note(study))
                outcomes = run_jobs(plan, workers, progress=progress)
        except Timeout as error:
            kind = "study" if isinstance(study, Study) else "sweep"
            raise ValueError(f"another process is running a {kind} in {folder}") from error
    left = [job.folder for job in plan.to_go]
    done = [label for label in runs if not any(home.is_relative_to(folder / label) for home in left)]
    return StudyResult(
        figure=draw_study(study, folder) if isinstance(study, Study) and not left else None,
        successes={label: last_success(Batches(folder / label).rows()) for label in done},
        failed={label: outcome.error for label, outcome in outcomes.items() if outcome.error},
        interrupted=any(outcome.interrupted for outcome in outcomes.values()),
    )


def unfinished_sweep(runs: Mapping[str, Recipe], folders: str | Path) -> Path | None:
    """Finds the newest folder of an unfinished sweep with exactly the given runs; None if there is none.

    Args:
        runs: recipes of the runs, by the names of their folders.
        folders: folder that contains the folders of sweeps.

    Example:
        >>> unfinished_sweep({}, Path("nowhere"))
    """
    for note in sorted(Path(folders).glob(f"*/{_NOTE}"), reverse=True):
        same = note.read_bytes() == _note(runs).encode()
        if same and not all(RunFolder(note.parent / label).is_done for label in runs):
            return note.parent
    return None


def _note(runs: Mapping[str, Recipe]) -> str:
    return json.dumps({label: recipe.to_dict() for label, recipe in runs.items()})


def draw_study(study: Study, folder: Path) -> Path:
    """Draws a study's metrics over environment steps, a panel for each task; returns the figure's path."""
    path = folder / f"{study.name}.png"
    panels: dict[str, dict[str, list[dict[str, float]]]] = {}
    for label, recipe in study.cells():
        panels.setdefault(recipe.task.name, {})[curve_label(label, recipe)] = Batches(folder / label).rows()
    plot_comparison(panels, path, metrics=study.figure)
    return path
