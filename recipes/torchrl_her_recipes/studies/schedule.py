"""Does the jobs of a plan, as many at once as there are places, and shows how far all of them are."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import closing
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from torchrl_her_recipes.runs.interrupt import Interrupted, soft_interrupt
from torchrl_her_recipes.studies.jobs import Outcome, kept_progress
from torchrl_her_recipes.studies.overview import Overview
from torchrl_her_recipes.studies.plan import Plan
from torchrl_her_recipes.studies.workers_local import LocalWorkers, Workers

_TICK = 1.0  # seconds


def run_planned(
    plan_jobs: Callable[[], Plan], folder: Path, what: str, workers: Workers | None, *, progress: bool
) -> tuple[Plan, dict[str, Any]]:
    """Plans jobs and does them; returns the plan, and the reasons of failures and whether it was interrupted.

    Raises:
        ValueError: another process does so in the same folder.
        KeyboardInterrupt: by a second Ctrl-C.
    """
    with closing(workers or LocalWorkers()) as workers:
        folder.mkdir(parents=True, exist_ok=True)
        try:
            with FileLock(folder / ".lock", timeout=0):
                plan = plan_jobs()
                outcomes = run_jobs(plan, workers, progress=progress)
        except Timeout as error:
            raise ValueError(f"another process is running a {what} in {folder}") from error
    failed = {label: outcome.error for label, outcome in outcomes.items() if outcome.error}
    return plan, {"failed": failed, "interrupted": any(own.interrupted for own in outcomes.values())}


def run_jobs(plan: Plan, workers: Workers, *, progress: bool = True) -> dict[str, Outcome]:
    """Does all jobs of a plan that are not done yet.

    One that fails holds no other back. The first Ctrl-C lets all of them save what they have; a later
    one ends them at once.

    Returns:
        What came of each job, by label.
    """
    jobs = plan.to_go
    outcomes: dict[str, Outcome] = {}
    with (
        closing(Overview(plan, workers, show=progress)) as overview,
        ThreadPoolExecutor(max(len(jobs), 1)) as threads,
        soft_interrupt() as check,
    ):
        waiting = {threads.submit(workers.run, job): job for job in jobs}

        def watch(check: Callable[[], None]) -> None:
            while waiting:
                for future in wait(waiting, _TICK, FIRST_COMPLETED).done:
                    job = waiting.pop(future)
                    outcomes[job.label] = _outcome(future)
                    plan.update({job.label: kept_progress(job)})
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


def _outcome(future: Future[Outcome]) -> Outcome:
    error = future.exception()
    return future.result() if error is None else Outcome(error=" ".join(f"{error!r}".split()))
