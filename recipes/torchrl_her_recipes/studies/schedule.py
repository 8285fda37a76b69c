"""Does the jobs of a plan, as many at once as there are places, and shows how far all of them are."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait

from tqdm import tqdm

from torchrl_her_recipes.runs.interrupt import Interrupted, soft_interrupt
from torchrl_her_recipes.studies.jobs import Job, Outcome, kept_progress
from torchrl_her_recipes.studies.plan import Plan, duration
from torchrl_her_recipes.studies.workers_local import Workers

_TICK = 1.0  # seconds
_BAR = "{percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} steps [{elapsed}{postfix}]"
_STOPPING = "{percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} steps [saving what there is]"


def run_jobs(plan: Plan, workers: Workers, *, progress: bool = True) -> dict[str, Outcome]:
    """Does all jobs of a plan that are not done yet.

    One that fails holds no other back. The first Ctrl-C lets all of them save what they have; a later
    one ends them at once.

    Args:
        plan: what to do; it is kept up to date.
        workers: who does it; they are closed in the end.
        progress: whether to show a bar.

    Returns:
        What came of each job, by label.

    Raises:
        KeyboardInterrupt: by a second Ctrl-C.
    """
    jobs = plan.to_go
    outcomes: dict[str, Outcome] = {}
    with (
        tqdm(total=plan.steps, unit_scale=True, bar_format=_BAR, disable=not progress) as bar,
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
                _show(bar, plan, workers, list(waiting.values()))
                check()

        try:
            watch(check)
        except Interrupted:
            bar.bar_format = _STOPPING
            workers.stop()
            watch(lambda: None)
        finally:
            workers.close()
    return outcomes


def _outcome(future: Future[Outcome]) -> Outcome:
    error = future.exception()
    return future.result() if error is None else Outcome(error=" ".join(f"{error!r}".split()))


def _show(bar: tqdm, plan: Plan, workers: Workers, left: Sequence[Job]) -> None:
    """Brings plan and bar up to date."""
    working = workers.progress()
    plan.update(working)
    bar.n = plan.steps - plan.steps_to_go(plan.jobs)
    to_go = duration(plan.wall_clock(left, workers.at_once))
    bar.set_postfix_str(f"{len(working)} running, {len(left) - len(working)} waiting, about {to_go} to go")
