"""Runs the unfinished runs of a study or sweep, on all cores or a cluster."""

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

_NOTE = "sweep.json"  # file that lists the single runs of a folder


@dataclass(frozen=True, kw_only=True)
class StudyResult:
    """The result of a study, or of single runs.

    Attributes:
        figure: the picture of a study, if all its runs are done.
        successes: success of each run in its last evaluation, by the name of its combination or single run.
            Combinations with unfinished runs are left out.
        failed: reasons of failures, by the label of the job. Other jobs are run nevertheless.
        interrupted: whether the study was stopped; it can be resumed.
    """

    figure: Path | None = None
    successes: dict[str, list[float]] = field(default_factory=dict)
    failed: dict[str, str] = field(default_factory=dict)
    interrupted: bool = False


def plan_study(study: Study | Mapping[str, Recipe], folder: Path) -> Plan:
    """Plans the jobs of a study, and estimates their time.

    Args:
        study: study to run; or recipes of single runs, by the names of their folders.
        folder: folder with a folder for each combination or single run, which may exist already. If an
            existing combination lacks seeds of the study, jobs are planned for these seeds.

    Raises:
        ValueError: the folder has a run of other options under the same name.
    """
    if isinstance(study, Study):
        cells = ((label, resolved(recipe)) for label, recipe in study.cells())
        jobs = [job for label, recipe in cells for job in plan_batches(label, recipe, folder)]
    else:
        jobs = [Job(label=label, recipe=resolved(run), folder=folder / label) for label, run in study.items()]
    return Plan(jobs)


def run_study(
    study: Study | Mapping[str, Recipe],
    folder: Path,
    *,
    workers: Workers | None = None,
    progress: bool = True,
) -> StudyResult:
    """Runs the unfinished jobs of a study, several at once, and draws its figure.

    Interrupted runs are resumed from their checkpoints.

    Args:
        study: study to run; or recipes of single runs, by the names of their folders.
        folder: folder in which each combination or single run gets a folder.
        workers: workers that run the jobs, by default a process for each core; closed at the end.
        progress: whether to show a progress bar for the whole study.

    Raises:
        ValueError: the folder has a run of other options under the same name, another process is using it, or
            a task names a module that must not be imported.
        KeyboardInterrupt: Ctrl-C was pressed a second time.
    """
    runs = dict(study.cells()) if isinstance(study, Study) else study
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


def unfinished_sweep(runs: Mapping[str, Recipe], folders: Path) -> Path | None:
    """Finds the newest folder of an unfinished sweep with exactly the given runs; None if there is none.

    Args:
        runs: recipes, by the names of their folders.
        folders: folder in which to search for folders of :func:`run_study`.

    Example:
        >>> unfinished_sweep({}, Path("nowhere"))
    """
    for note in sorted(folders.glob(f"*/{_NOTE}"), reverse=True):
        same = note.read_bytes() == _note(runs).encode()
        if same and not all(RunFolder(note.parent / label).is_done for label in runs):
            return note.parent
    return None


def _note(runs: Mapping[str, Recipe]) -> str:
    return json.dumps({label: recipe.to_dict() for label, recipe in runs.items()})


def draw_study(study: Study, folder: Path) -> Path:
    """Draws metrics over environment steps: a panel for each task, a curve for each combination on it."""
    path = folder / f"{study.name}.png"
    panels: dict[str, dict[str, list[dict[str, float]]]] = {}
    for label, recipe in study.cells():
        panels.setdefault(recipe.task.name, {})[curve_label(label, recipe)] = Batches(folder / label).rows()
    plot_comparison(panels, path, metrics=study.figure)
    return path
