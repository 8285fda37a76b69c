"""Worker processes: they do jobs, stop when they are told to, and may die."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from multiprocessing import active_children
from pathlib import Path
from typing import Any

import pytest

from torchrl_her_recipes.studies.jobs import Job, Outcome, Progress, can_resume
from torchrl_her_recipes.studies.workers import LocalWorkers

from ..small import small
from .forked_worker import fork_workers

LONG = 10_000  # epochs


@pytest.fixture
def workers(monkeypatch: pytest.MonkeyPatch) -> Iterator[LocalWorkers]:
    """One worker."""
    fork_workers(monkeypatch)
    workers = LocalWorkers(1)
    yield workers
    workers.close()


@pytest.fixture
def submit(workers: LocalWorkers) -> Iterator[Callable[[Job], Future[Outcome]]]:
    """Gives it a job without waiting for it."""
    threads = ThreadPoolExecutor(3)
    yield lambda job: threads.submit(workers.run, job)
    workers.close()
    threads.shutdown()


def job(folder: Path, **options: Any) -> Job:
    label = f"epochs_{options.get('epochs')}"
    recipe = small(task="hand_v0", compile="never", **options)
    return Job(label=label, recipe=recipe, folder=folder / label)


def wait_until(happened: Callable[[], bool], *, during: Future[Outcome]) -> None:
    while not happened():
        assert not during.done()
        time.sleep(0.05)


@pytest.mark.long
def test_one_process_does_several_jobs_until_it_is_told_to_stop(
    tmp_path: Path, workers: LocalWorkers, submit: Callable[[Job], Future[Outcome]]
) -> None:
    broken, whole, endless = (job(tmp_path, epochs=epochs) for epochs in (1, 2, LONG))
    broken.folder.write_text("this is no folder")
    assert submit(broken).result().error.startswith("NotADirectoryError: ")
    assert submit(whole).result() == Outcome()
    outcome = submit(endless)
    wait_until(lambda: workers.progress().get(endless.label, Progress()).epochs > 0, during=outcome)
    workers.stop()
    assert outcome.result() == Outcome(interrupted=True)
    assert can_resume(endless.folder)
    assert submit(whole).result() == Outcome(interrupted=True)  # there are no more to be done


def test_a_process_that_dies_takes_only_its_job_along(
    tmp_path: Path, workers: LocalWorkers, submit: Callable[[Job], Future[Outcome]]
) -> None:
    before = set(active_children())
    outcome = submit(job(tmp_path, epochs=LONG))
    wait_until(lambda: bool(workers.progress()), during=outcome)
    (process,) = set(active_children()) - before
    process.kill()
    assert outcome.result().error == "its process was ended by SIGKILL, perhaps because memory ran out"
    assert workers.progress() == {}
    assert set(active_children()) == before  # the next job gets a new one


def test_ctrl_c_while_they_are_closed_blocks_nobody() -> None:
    class Slow:
        def end(self) -> str:
            raise KeyboardInterrupt

    workers = LocalWorkers(2)
    workers._places.get()
    workers._places.put(Slow())  # type: ignore[arg-type]
    with pytest.raises(KeyboardInterrupt):
        workers.close()
    workers.close()


def test_how_many_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _process: {0, 2, 5}, raising=False)
    assert LocalWorkers().at_once == 3  # as many as cores that it may use
    with pytest.raises(ValueError, match="jobs must be at least 1, got 0"):
        LocalWorkers(0)
