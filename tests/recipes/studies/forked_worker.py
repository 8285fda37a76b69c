"""Worker processes of studies that are forks of one that has imported torch."""

from __future__ import annotations

import os
import sys
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from types import SimpleNamespace
from typing import Any

import pytest

from torchrl_her_recipes.studies import worker_main, workers

from ...forks import fork


def fork_workers(patch: pytest.MonkeyPatch) -> None:
    """Lets :class:`LocalWorkers` fork its processes: new ones would take seconds to import torch."""
    patch.setattr(workers, "subprocess", SimpleNamespace(Popen=_Forked, PIPE=None))


class _Forked:
    """As much of a ``subprocess.Popen`` as workers use."""

    def __init__(self, *_args: Any, **_options: Any) -> None:
        jobs, to_worker = Pipe(duplex=False)
        from_worker, answers = Pipe(duplex=False)
        self._process = fork(_work, jobs, answers)
        self.pid = self._process.pid
        jobs.close()
        answers.close()
        self.stdin = os.fdopen(os.dup(to_worker.fileno()), "wb")
        self.stdout = os.fdopen(os.dup(from_worker.fileno()), "rb")
        to_worker.close()
        from_worker.close()

    def kill(self) -> None:
        self._process.kill()

    def wait(self) -> int | None:
        self._process.join()
        return self._process.exitcode


def _work(jobs: Connection, answers: Connection) -> None:
    serve(jobs.fileno(), answers.fileno())


def serve(jobs: int, answers: int) -> None:
    """Runs a worker in a session of its own, with file descriptors as its standard input and output."""
    os.setsid()
    for place, descriptor in enumerate((jobs, answers)):
        os.dup2(descriptor, place)
        os.close(descriptor)
    sys.stdin, sys.stdout = os.fdopen(0), os.fdopen(1, "w")
    worker_main.main()
