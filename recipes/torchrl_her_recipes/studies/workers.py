"""Workers that run the jobs of a study: their interface, and worker processes on this machine."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
from contextlib import suppress
from importlib.util import find_spec
from queue import LifoQueue
from typing import Protocol

from torchrl_her_recipes.config.values import load_name
from torchrl_her_recipes.studies.jobs import Job, Outcome, Progress, read_progress

_COMMAND = [sys.executable, "-P", "-m", "torchrl_her_recipes.studies.worker_main"]
_ON_RAY = "torchrl_her_recipes.studies.workers_ray:RayWorkers"


class Workers(Protocol):
    """Interface of workers that :func:`torchrl_her_recipes.studies.schedule.run_jobs` needs."""

    @property
    def at_once(self) -> int:
        """Largest number of jobs that run at the same time."""

    def run(self, job: Job) -> Outcome:
        """Waits for a free worker, runs the job there, and returns its outcome when it has ended.

        Several threads call this method at once. They must not run jobs in one process, since threads share
        TorchRL's exploration type and torch's random numbers.
        """

    def progress(self) -> dict[str, Progress]:
        """Returns the progress of running jobs, by label."""

    def stop(self) -> None:
        """Makes all jobs save their state and stop, without waiting for them."""

    def close(self) -> None:
        """Kills running jobs and releases all resources."""


class LocalWorkers:
    """Worker processes on this machine, each of which runs one job at a time; see :class:`Workers`.

    Each process has its own session, so that Ctrl-C in the terminal does not reach it. Instead, :meth:`stop`
    makes its job save its state first.

    Args:
        at_once: number of processes; by default one for each core.
    """

    def __init__(self, at_once: int | None = None) -> None:
        if at_once is not None and at_once < 1:
            raise ValueError(f"jobs must be at least 1, got {at_once}")
        self.at_once = at_once or _cores()
        self._places: LifoQueue[_Worker | None] = LifoQueue()  # for each free slot, an idle process or None
        for _ in range(self.at_once):
            self._places.put(None)
        self._busy: dict[str, tuple[Job, _Worker]] = {}
        self._stopped = False

    def run(self, job: Job) -> Outcome:
        worker = self._places.get()
        try:
            if self._stopped:
                return Outcome(interrupted=True)
            worker = worker or _Worker()
            self._busy[job.label] = job, worker  # from here on, stop() reaches the job
            if self._stopped:
                worker.stop()
            outcome = worker.run(job)
            return Outcome(interrupted=True) if outcome.error and self._stopped else outcome
        finally:
            self._busy.pop(job.label, None)
            self._places.put(worker if worker and not worker.ended else None)

    def progress(self) -> dict[str, Progress]:
        return {label: read_progress(job.folder) for label, (job, _) in list(self._busy.items())}

    def stop(self) -> None:
        self._stopped = True
        for _, worker in list(self._busy.values()):
            worker.stop()

    def close(self) -> None:
        self._stopped = True
        for _, worker in list(self._busy.values()):
            worker.kill()
        places: list[_Worker | None] = []
        try:
            while len(places) < self.at_once:
                places.append(self._places.get())
            for place in places:
                if place is not None:
                    place.end()
        finally:  # even after Ctrl-C, since close() may be called again and waits for all slots
            for _ in places:
                self._places.put(None)


def _cores() -> int:
    """Returns the number of cores that this process may use, which taskset or a job scheduler can limit."""
    affinity = getattr(os, "sched_getaffinity", None)  # macOS has none
    return len(affinity(0)) if affinity else os.cpu_count() or 1


class _Worker:
    """Starts and controls one process that runs :mod:`torchrl_her_recipes.studies.worker_main`."""

    def __init__(self) -> None:
        environment = {"OMP_NUM_THREADS": "1", **os.environ}  # one thread, since each process has one core
        self._process = subprocess.Popen(
            _COMMAND, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment, start_new_session=True
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._jobs, self._answers = self._process.stdin, self._process.stdout
        self.ended = False

    def run(self, job: Job) -> Outcome:
        try:
            pickle.dump(job.to_plain(), self._jobs)
            self._jobs.flush()
            return pickle.load(self._answers)
        except (OSError, EOFError, ValueError, pickle.UnpicklingError):  # the pipes are broken or closed
            return Outcome(error=self.end(), died=True)

    def stop(self) -> None:
        with suppress(BrokenPipeError):  # the process has ended already
            self._jobs.close()

    def kill(self) -> None:
        self._process.kill()

    def end(self) -> str:
        """Waits until the process has ended, and describes how it ended."""
        self.stop()
        code = self._process.wait()
        self._answers.close()
        self.ended = True
        if code >= 0:
            return f"its process ended with code {code}"
        hint = ", perhaps because memory ran out" if code == -signal.SIGKILL else ""
        return f"its process was ended by {signal.Signals(-code).name}{hint}"


def make_workers(*, jobs: int | None = None, ray: str | None = None, gpus_per_job: float = 0.0) -> Workers:
    """Makes workers: processes on this machine, or the nodes of a Ray cluster.

    Args:
        jobs: number of jobs that run at once on this machine; None for the number of cores.
        ray: address of a Ray cluster, ``auto`` or ``HOST:PORT``; None for this machine.
        gpus_per_job: number of GPUs for each job on a cluster, such as 0.25.

    Raises:
        ImportError: ``ray`` is given, but Ray is not installed.
        ValueError: no node of the cluster has this number of GPUs.
        ConnectionError: there is no cluster at the address.
    """
    if ray is None:
        return LocalWorkers(jobs)
    if find_spec("ray") is None:
        raise ImportError("--ray needs Ray: pip install '.[cluster]'")
    workers: Workers = load_name(_ON_RAY)(ray, gpus_per_job=gpus_per_job)
    return workers
