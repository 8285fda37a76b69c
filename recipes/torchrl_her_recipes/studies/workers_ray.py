"""Runs the jobs of a study on the nodes of a Ray cluster. Needs the extra `cluster`.

A job runs in a temporary folder on a node with a free core; when it ends, its files are sent to this machine.
Nodes need this package, but no shared disk.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import ray
from ray.exceptions import RayError
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from torchrl_her_recipes.components.collection.cluster import gpus, join, one_line, resource
from torchrl_her_recipes.studies.jobs import (
    Job,
    Outcome,
    Progress,
    can_resume,
    pack,
    read_progress,
    run_job,
    unpack,
)

_RETRIES = 3  # number of times that Ray runs a job again if its node or process died
_REPORT = 0.5  # seconds between two reports of a job's progress


class RayWorkers:
    """Workers on the nodes of a Ray cluster, one for each core; see ``Workers`` in ``studies.workers``.

    If the node or the process of a job dies, Ray runs the job again, up to three times.

    Args:
        address: address of the cluster, HOST:PORT, or ``auto`` for the cluster of this machine.
        gpus_per_job: number of GPUs for each job, such as 0.25; 0 for none.

    Raises:
        ConnectionError: there is no cluster at the address.
        ValueError: no node of the cluster has this number of GPUs.
    """

    def __init__(self, address: str = "auto", *, gpus_per_job: float = 0.0) -> None:
        if gpus_per_job > 1 and gpus_per_job != int(gpus_per_job):
            raise ValueError(f"gpus_per_job must be at most 1 or a whole number, got {gpus_per_job:g}")
        self._joined, self._gpus = join(address), gpus_per_job
        if gpus_per_job and self._places_on_gpus() == 0:
            self._leave()
            raise ValueError(f"no node of the cluster has gpus_per_job={gpus_per_job:g} GPUs")
        this_node = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=False)
        board = ray.remote(num_cpus=0, scheduling_strategy=this_node)(Board)
        self._board = board.remote()
        self._tasks: dict[str, ray.ObjectRef] = {}
        self._stopped = False

    @property
    def at_once(self) -> int:
        """Number of jobs for which the cluster has enough cores and GPUs."""
        cores = int(resource("CPU"))
        return min(cores, self._places_on_gpus()) if self._gpus else cores

    def _places_on_gpus(self) -> int:
        """Returns the number of jobs for which the cluster has enough GPUs."""
        if self._gpus > 1:
            return sum(int(count // self._gpus) for count in gpus())
        return sum(int(count) * int(1 / self._gpus) for count in gpus())

    def _leave(self) -> None:
        if self._joined:
            ray.shutdown()

    def run(self, job: Job) -> Outcome:
        """Runs a job on a node with a free core, and writes its files to the job's folder when it ends."""
        needs = _work.options(num_cpus=job.recipe.run.threads, num_gpus=self._gpus)
        task = needs.remote(job.to_plain(), _begun(job), self._board)
        self._tasks[job.label] = task  # from here on, stop() reaches the job
        if self._stopped:
            ray.cancel(task)
        try:
            outcome, files = ray.get(task)
        except RayError as error:
            return Outcome(interrupted=True) if self._stopped else Outcome(error=one_line(error))
        finally:
            del self._tasks[job.label]
        if files:
            unpack(files, job.folder)
        return outcome

    def progress(self) -> dict[str, Progress]:
        try:
            board = ray.get(self._board.read.remote())
        except RayError:  # the cluster is lost; run() reports this error
            board = {}
        return {label: board[label] for label in list(self._tasks) if label in board}

    def stop(self) -> None:
        self._stopped = True
        for task in list(self._tasks.values()):
            ray.cancel(task)  # raises a KeyboardInterrupt in a running job, like Ctrl-C

    def close(self) -> None:
        """Kills running jobs and leaves the cluster."""
        self._stopped = True
        while self._tasks:
            for task in list(self._tasks.values()):
                ray.cancel(task, force=True)
            time.sleep(0.1)  # waits until run() has returned
        self._leave()


class Board:
    """Ray actor that collects the progress of jobs, which nodes report to it."""

    def __init__(self) -> None:
        self._progress: dict[str, Progress] = {}

    def write(self, label: str, progress: Progress) -> None:
        """Stores the progress of a job."""
        self._progress[label] = progress

    def read(self) -> dict[str, Progress]:
        """Returns all reported progress, by label."""
        return self._progress


@ray.remote(max_retries=_RETRIES)
def _work(values: dict[str, Any], files: dict[str, bytes], board: Any) -> tuple[Outcome, dict[str, bytes]]:
    """Runs a job on a node, from the files of its unfinished run if there are any; returns its new files."""
    job = Job.from_plain(values)
    with TemporaryDirectory(prefix="torchrl-her-") as place:
        local_job = replace(job, folder=Path(place) / job.label)
        if files:
            unpack(files, local_job.folder)
        with _reporting(local_job, board):
            outcome = run_job(local_job)
        return outcome, pack(local_job.folder, checkpoints=outcome != Outcome())


@contextmanager
def _reporting(job: Job, board: Any) -> Iterator[None]:
    """Context manager that reports the progress of a job to the board until the block ends."""
    ended = threading.Event()

    def report() -> None:
        before = None
        while not ended.wait(_REPORT):
            progress = read_progress(job.folder)
            if progress != before:
                board.write.remote(job.label, progress)
                before = progress

    thread = threading.Thread(target=report)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def _begun(job: Job) -> dict[str, bytes]:
    """Returns the files of a job's unfinished run, by path; empty if it has no checkpoint."""
    return pack(job.folder, checkpoints=True) if can_resume(job.folder) else {}
