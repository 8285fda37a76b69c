"""Runs the unfinished jobs of a plan on workers, several at once, and shows their progress."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import closing

from tqdm import tqdm

from torchrl_her_recipes.runs.interrupt import Interrupted, soft_interrupt
from torchrl_her_recipes.studies.jobs import Job, Outcome, kept_progress
from torchrl_her_recipes.studies.plan import Plan
from torchrl_her_recipes.studies.workers import Workers

_TICK = 1.0  # seconds between two updates of the displayed progress
_BAR = "{percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} steps [{elapsed}{postfix}]"
_STOPPING = "{percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} steps [saving what there is]"
_PART = 0.05  # fraction of all steps after which another line is printed, if there is no terminal


def run_jobs(plan: Plan, workers: Workers, *, progress: bool = True) -> dict[str, Outcome]:
    """Runs all unfinished jobs of a plan.

    If a job fails, the other jobs continue. After a first Ctrl-C, all jobs save their state and stop; a
    second Ctrl-C ends them at once.

    Returns:
        The outcome of each job, by label.
    """
    jobs = plan.to_go
    outcomes: dict[str, Outcome] = {}
    with (
        closing(_Overview(plan, workers, show=progress)) as overview,
        ThreadPoolExecutor(max(len(jobs), 1)) as threads,
        soft_interrupt() as check,
    ):
        waiting = {threads.submit(workers.run, job): job for job in jobs}

        def watch(check: Callable[[], None]) -> None:
            while waiting:
                for future in wait(waiting, _TICK, FIRST_COMPLETED).done:
                    job = waiting.pop(future)
                    outcomes[job.label] = outcome_of(future)
                    plan.progress[job.label] = kept_progress(job)
                    overview.ended(job, outcomes[job.label])
                overview.show(list(waiting.values()))
                check()

        try:
            watch(check)
        except Interrupted:
            overview.stopping()
            workers.stop()
            watch(lambda: None)
        finally:
            workers.close()
    return outcomes


def outcome_of(future: Future[Outcome]) -> Outcome:
    """Returns the outcome of a job; an error of the worker itself becomes a failed outcome."""
    error = future.exception()
    return future.result() if error is None else Outcome(error=" ".join(f"{error!r}".split()))


class _Overview:
    """Shows the progress of jobs on the standard error stream: as a bar on a terminal, else as some lines."""

    def __init__(self, plan: Plan, workers: Workers, *, show: bool) -> None:
        self.plan, self.workers = plan, workers
        self.lines = show and not sys.stderr.isatty()
        self.bar = tqdm(total=plan.steps, unit_scale=True, bar_format=_BAR, disable=not show or self.lines)
        self.close = self.bar.close
        self._next = self._share() + _PART

    def show(self, left: Sequence[Job]) -> None:
        """Reads the progress of running jobs and updates the bar; ``left`` are the unfinished jobs."""
        working = self.workers.progress()
        self.plan.progress.update(working)
        self.bar.n = self.plan.steps - self.plan.steps_to_go(self.plan.jobs)
        to_go = self.plan.about(left, self.workers.at_once, ", {} to go")
        state = f"{len(working)} running, {len(left) - len(working)} waiting{to_go}"
        self.bar.set_postfix_str(state)
        share = self._share()
        if left and share >= self._next:
            self._next = share + _PART
            self._say(f"{share:.0%} of all steps: {state}")

    def ended(self, job: Job, outcome: Outcome) -> None:
        """Prints a line with the outcome of a job that has ended, if there is no terminal."""
        how = "failed" if outcome.error else "interrupted" if outcome.interrupted else "done"
        self._say(f"{job.label}: {how}")

    def stopping(self) -> None:
        """Shows that all jobs are saving their state to stop."""
        self.bar.bar_format = _STOPPING
        self._say("saving what there is")

    def _say(self, line: str) -> None:
        if self.lines:
            tqdm.write(line, file=sys.stderr)

    def _share(self) -> float:
        return 1 - self.plan.steps_to_go(self.plan.jobs) / max(self.plan.steps, 1)
