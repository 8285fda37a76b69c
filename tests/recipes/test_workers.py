"""Worker processes: they do jobs, stop when they are told to, and may die."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from torchrl_her_recipes.jobs import Job, Outcome, can_resume
from torchrl_her_recipes.workers import LocalWorkers

from .small import small

LONG = 10_000  # epochs


@pytest.fixture
def workers() -> Iterator[LocalWorkers]:
    workers = LocalWorkers(1)
    yield workers
    workers.close()


def job(folder: Path, **options: Any) -> Job:
    label = f"epochs_{options.get('epochs')}"
    recipe = small(task="hand_v0", compile="never", **options)
    return Job(label=label, recipe=recipe, folder=folder / label)


def wait_until(happened: Callable[[], bool]) -> None:
    until = time.monotonic() + 50
    while not happened():
        assert time.monotonic() < until
        time.sleep(0.05)


def test_one_process_does_several_jobs_until_it_is_told_to_stop(
    tmp_path: Path, workers: LocalWorkers
) -> None:
    broken, whole, endless = (job(tmp_path, epochs=epochs) for epochs in (1, 2, LONG))
    broken.folder.write_text("this is no folder")
    with ThreadPoolExecutor(3) as threads:
        outcomes = [threads.submit(workers.run, own) for own in (broken, whole, endless)]
        assert outcomes[0].result().error.startswith("NotADirectoryError: ")
        assert outcomes[1].result() == Outcome()
        wait_until(lambda: workers.progress().get(endless.label, (0,))[0] > 0)
        workers.stop()
        assert outcomes[2].result() == Outcome(interrupted=True)
    assert can_resume(endless.folder)
    assert workers.run(whole) == Outcome(interrupted=True)  # there are no more to be done


def test_a_process_that_dies_takes_only_its_job_along(tmp_path: Path, workers: LocalWorkers) -> None:
    with ThreadPoolExecutor(1) as threads:
        outcome = threads.submit(workers.run, job(tmp_path, epochs=LONG))
        wait_until(lambda: bool(workers.progress()))
        (pid,) = children()
        os.kill(pid, signal.SIGKILL)
        assert outcome.result().error == "its process was ended by SIGKILL, perhaps for want of memory"
    assert workers.progress() == {}
    assert workers._places.get_nowait() is None  # the next job gets a new one
    workers._places.put(None)


def children() -> list[int]:
    """Worker processes of this one."""
    command = ["pgrep", "-P", str(os.getpid()), "-f", "worker_process"]
    return [int(line) for line in subprocess.run(command, capture_output=True, text=True).stdout.split()]


def test_how_many_at_once() -> None:
    assert LocalWorkers().at_once == os.cpu_count()
    with pytest.raises(ValueError, match="jobs must be at least 1, got 0"):
        LocalWorkers(0)
