"""What there is to do for a study, and how long it will take."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from heapq import heapreplace

from torchrl_her_recipes.config.recipe import Recipe
from torchrl_her_recipes.studies.jobs import Job, Progress, kept_progress

# Seconds of a core, as a first guess: what a study's own runs take soon outweighs it.
_FRAME = 5e-5  # an environment step of a run
_UPDATE = 3e-4  # a gradient step of a run
_PRODUCT = 5e-11  # each row of it and each weight between hidden layers
_PRIOR = 30.0  # measured seconds that count as much as the guess


def expected_seconds(recipe: Recipe, epochs: int) -> float:
    """About how long some epochs of a batched run take on one core.

    Example:
        >>> from torchrl_her_recipes import load_preset, make_recipe
        >>> fifteen = make_recipe(load_preset("throwing"), num_runs=15)
        >>> round(expected_seconds(fifteen, fifteen.run.epochs) / 60)
        12
    """
    steps = epochs * recipe.collection.epoch_frames * recipe.run.num_runs
    update = _UPDATE + _PRODUCT * recipe.replay.batch_size * recipe.learner.hidden_weights
    return steps * (_FRAME + update / recipe.collection.frames_per_update)


def wall_clock(seconds: Iterable[float], at_once: int) -> float:
    """How long it takes until all are done, each begun when a place is free.

    Example:
        >>> wall_clock([3.0, 2.0, 2.0], at_once=2)
        4.0
    """
    ends = [0.0] * max(at_once, 1)
    for own in seconds:
        heapreplace(ends, ends[0] + own)
    return max(ends)


def duration(seconds: float) -> str:
    """For people.

    Example:
        >>> duration(42), duration(8 * 60), duration(5000)
        ('42 s', '8 min', '1 h 23 min')
    """
    if seconds < 99.5:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"


class Plan:
    """The jobs of a study, and how far each of them is.

    Attributes:
        jobs: likewise.
        progress: how far each is, by label.
    """

    def __init__(self, jobs: Iterable[Job]) -> None:
        self.jobs = list(jobs)
        self.progress = {job.label: kept_progress(job) for job in self.jobs}

    def update(self, progress: Mapping[str, Progress]) -> None:
        """Takes in how far some of them are by now."""
        self.progress.update(progress)

    def is_done(self, job: Job) -> bool:
        """Whether a job has reached its last epoch."""
        return self.progress[job.label].epochs >= job.recipe.run.epochs

    @property
    def to_go(self) -> list[Job]:
        """What is not done yet, the longest first: no core waits for long at the end."""
        return sorted(
            (job for job in self.jobs if not self.is_done(job)), key=self.seconds_to_go, reverse=True
        )

    @property
    def steps(self) -> int:
        """Environment steps of all runs together."""
        return sum(job.recipe.total_frames * job.recipe.run.num_runs for job in self.jobs)

    def steps_to_go(self, jobs: Iterable[Job]) -> int:
        """Environment steps that are left of some jobs."""
        return sum(
            self._epochs_to_go(job) * job.recipe.collection.epoch_frames * job.recipe.run.num_runs
            for job in jobs
        )

    def seconds_to_go(self, job: Job) -> float:
        """About how long a job that has not ended will still take on one core."""
        return self._pace() * expected_seconds(job.recipe, self._epochs_to_go(job))

    def wall_clock(self, jobs: Iterable[Job], at_once: int) -> float:
        """About how many seconds it is until some jobs are done, so many at once."""
        return wall_clock(map(self.seconds_to_go, jobs), at_once)

    def table(self, at_once: int) -> list[str]:
        """A line for each job, with its state and what it still takes; and one for all, so many at once."""
        width = max(len(job.label) for job in self.jobs)
        lines = [f"  {job.label:<{width}}  {self._state(job)}" for job in self.jobs]
        if to_go := self.to_go:
            about = duration(self.wall_clock(to_go, at_once))
            lines.append(f"about {about}, {min(at_once, len(to_go))} at once")
        return lines

    def _state(self, job: Job) -> str:
        if self.is_done(job):
            return "done"
        epochs = self.progress[job.label].epochs
        state = f"at epoch {epochs} of {job.recipe.run.epochs}" if epochs else "to do"
        left = f"{self.steps_to_go([job]):>14,} steps to go, about {duration(self.seconds_to_go(job))}"
        return f"{state:<18}{left}"

    def _epochs_to_go(self, job: Job) -> int:
        return max(job.recipe.run.epochs - self.progress[job.label].epochs, 0)

    def _pace(self) -> float:
        """How much longer this study's epochs take than expected."""
        begun = [(job.recipe, self.progress[job.label]) for job in self.jobs]
        expected = sum(expected_seconds(recipe, done.epochs) for recipe, done in begun)
        return (_PRIOR + sum(done.seconds for _, done in begun)) / (_PRIOR + expected)
