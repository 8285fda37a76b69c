"""Runs a sweep: any runs, each in a folder of its own, on all cores; it goes on where it stopped."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torchrl_her.files.writing import write_text
from torchrl_her_recipes.components.first_look import resolved
from torchrl_her_recipes.config.recipe import Recipe
from torchrl_her_recipes.runs.folder import RunFolder
from torchrl_her_recipes.runs.run import last_success
from torchrl_her_recipes.studies.jobs import Job
from torchrl_her_recipes.studies.plan import Plan
from torchrl_her_recipes.studies.schedule import run_planned
from torchrl_her_recipes.studies.workers_local import Workers

_NOTE = "sweep.json"  # which runs a folder is for


@dataclass(frozen=True, kw_only=True)
class SweepResult:
    """What came of a sweep.

    Attributes:
        successes: of each run that is done, in its last evaluation; of several side by side each.
        failed: why, by the name of the run. The others are not held back by it.
        interrupted: whether somebody stopped it. It goes on if it is run again.
    """

    successes: dict[str, list[float]] = field(default_factory=dict)
    failed: dict[str, str] = field(default_factory=dict)
    interrupted: bool = False


def plan_sweep(runs: Mapping[str, Recipe], folder: Path) -> Plan:
    """What there is to do, and about how long it takes.

    Args:
        runs: recipes, by the names of their folders.
        folder: these go into it, or are there already.

    Raises:
        ValueError: a run in the folder has the same name and other options.
    """
    jobs = [Job(label=label, recipe=resolved(own), folder=folder / label) for label, own in runs.items()]
    for job in jobs:
        if _begun(job) != job.recipe:
            raise ValueError(f"{job.folder} holds a run with other options; choose another folder")
    return Plan(jobs)


def run_sweep(
    runs: Mapping[str, Recipe], folder: Path, *, workers: Workers | None = None, progress: bool = True
) -> SweepResult:
    """Trains all runs that are not done yet, several at once.

    Args:
        runs: recipes, by the names of their folders.
        folder: these go into it.
        workers: who does it; by default a process for each core. They are closed in the end.
        progress: whether to show how far all of it is.

    Raises:
        ValueError: a run in the folder has the same name and other options, or somebody is at work in it.
        KeyboardInterrupt: by a second Ctrl-C.
    """

    def make_plan() -> Plan:
        plan = plan_sweep(runs, folder)
        write_text(folder / _NOTE, json.dumps(_plain(runs)))
        return plan

    plan, came = run_planned(make_plan, folder, "sweep", workers, progress=progress)
    done = [job for job in plan.jobs if plan.is_done(job)]
    return SweepResult(
        successes={job.label: last_success(RunFolder(job.folder).rows()) for job in done},
        **came,
    )


def unfinished_sweep(runs: Mapping[str, Recipe], folders: Path) -> Path | None:
    """The newest folder of just these runs that has some to go; None if there is none.

    Args:
        runs: recipes, by the names of their folders.
        folders: where sweeps are looked for.

    Example:
        >>> unfinished_sweep({}, Path("nowhere"))
    """
    wanted = _plain(runs)
    for note in sorted(folders.glob(f"*/{_NOTE}"), reverse=True):
        with suppress(ValueError, AttributeError):  # of what was torn when the power failed
            noted = {label: Recipe.from_dict(own) for label, own in json.loads(note.read_text()).items()}
            if _plain(noted) == wanted and not all(RunFolder(note.parent / label).is_done for label in runs):
                return note.parent
    return None


def _plain(runs: Mapping[str, Recipe]) -> Any:
    return json.loads(json.dumps({label: recipe.to_dict() for label, recipe in runs.items()}))


def _begun(job: Job) -> Recipe:
    """What a run's folder is for; one whose configuration is missing, or torn, is as planned."""
    try:
        return RunFolder(job.folder).recipe()
    except (OSError, ValueError):
        return job.recipe
