"""The class :class:`Plan`: the unfinished jobs of a study, with an estimate of the time that they need."""

from __future__ import annotations

import math
from collections.abc import Iterable
from heapq import heapreplace

from torchrl_her_recipes.config.recipe import Recipe
from torchrl_her_recipes.runs.folder import RunFolder
from torchrl_her_recipes.studies.jobs import Job, kept_progress

# Cost of a gradient step in addition to its matrix products; the unit of both is rows times weights.
_OVERHEAD = 1e7


def relative_cost(recipe: Recipe, epochs: int) -> float:
    """Estimates the cost of ``epochs`` epochs of a job, in an arbitrary unit, from its gradient steps.

    Example:
        >>> from torchrl_her_recipes import load_preset, make_recipe
        >>> six, two = (make_recipe(load_preset("throwing"), num_runs=runs) for runs in (6, 2))
        >>> relative_cost(six, 2) / relative_cost(two, 3)
        2.0
    """
    steps = epochs * recipe.collection.epoch_frames * recipe.run.num_runs
    products = recipe.replay.batch_size * recipe.learner.hidden_weights
    return steps / recipe.collection.frames_per_update * (_OVERHEAD + products)


def wall_clock(seconds: Iterable[float], at_once: int) -> float:
    """Computes the seconds until all jobs are done, if each starts as soon as one of the workers is free.

    Example:
        >>> wall_clock([3.0, 2.0, 2.0], at_once=2)
        4.0
    """
    ends = [0.0] * max(at_once, 1)
    for job_seconds in seconds:
        heapreplace(ends, ends[0] + job_seconds)
    return max(ends)


def duration(seconds: float) -> str:
    """Formats a number of seconds as seconds, minutes or hours.

    Example:
        >>> duration(42), duration(8 * 60), duration(5000)
        ('42 s', '8 min', '1 h 23 min')
    """
    if seconds < 99.5:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"


class Plan:
    """The jobs of a study, with the progress of each job.

    Args:
        jobs: the jobs, in the order in which :meth:`table` lists them.

    Attributes:
        progress: finished epochs and seconds of each job, by label.

    Raises:
        ValueError: the folder of a job already has a run with other options.
    """

    def __init__(self, jobs: Iterable[Job]) -> None:
        self.jobs = list(jobs)
        for job in self.jobs:
            if _begun(job) != job.recipe:
                raise ValueError(f"{job.folder} holds a run with other options; choose another folder")
        self.progress = {job.label: kept_progress(job) for job in self.jobs}

    def is_done(self, job: Job) -> bool:
        """Returns whether a job has reached its last epoch."""
        return self._epochs_to_go(job) == 0

    @property
    def to_go(self) -> list[Job]:
        """Unfinished jobs, the longest first, so that few cores are idle toward the end of the study."""
        return sorted((job for job in self.jobs if not self.is_done(job)), key=self._cost_to_go, reverse=True)

    @property
    def steps(self) -> int:
        """Number of environment steps of all runs together."""
        return sum(job.recipe.total_frames * job.recipe.run.num_runs for job in self.jobs)

    def steps_to_go(self, jobs: Iterable[Job]) -> int:
        """Returns the number of environment steps that the given jobs have not done yet."""
        return sum(
            self._epochs_to_go(job) * job.recipe.collection.epoch_frames * job.recipe.run.num_runs
            for job in jobs
        )

    def wall_clock(self, jobs: Iterable[Job], at_once: int) -> float:
        """Estimates the seconds until the given jobs are done; NaN if no epoch of the study is done yet."""
        costs = {job.label: relative_cost(job.recipe, self.progress[job.label].epochs) for job in self.jobs}
        if not any(costs.values()):
            return math.nan
        pace = sum(done.seconds for done in self.progress.values()) / sum(costs.values())
        return pace * wall_clock(map(self._cost_to_go, jobs), at_once)

    def table(self, at_once: int) -> list[str]:
        """Formats a line for each job, with its state and remaining time, and a line for all jobs."""
        width = max(len(job.label) for job in self.jobs)
        lines = [f"  {job.label:<{width}}  {self._state(job)}" for job in self.jobs]
        if to_go := self.to_go:
            lines.append(f"{self.about(to_go, at_once, '{}, ')}{min(at_once, len(to_go))} at once")
        return lines

    def about(self, jobs: Iterable[Job], at_once: int, text: str) -> str:
        """Replaces ``{}`` in a text by the time until jobs are done; returns "" if the time is unknown."""
        seconds = self.wall_clock(jobs, at_once)
        return "" if math.isnan(seconds) else text.format(f"about {duration(seconds)}")

    def _state(self, job: Job) -> str:
        if self.is_done(job):
            return "done"
        epochs = self.progress[job.label].epochs
        state = f"at epoch {epochs} of {job.recipe.run.epochs}" if epochs else "to do"
        return f"{state:<18}{self.steps_to_go([job]):>14,} steps to go{self.about([job], 1, ', {}')}"

    def _epochs_to_go(self, job: Job) -> int:
        return max(job.recipe.run.epochs - self.progress[job.label].epochs, 0)

    def _cost_to_go(self, job: Job) -> float:
        return relative_cost(job.recipe, self._epochs_to_go(job))


def _begun(job: Job) -> Recipe:
    """Returns the recipe of the run in a job's folder; the job's own recipe if there is no readable run."""
    try:
        return RunFolder(job.folder).recipe()
    except ValueError:
        return job.recipe
