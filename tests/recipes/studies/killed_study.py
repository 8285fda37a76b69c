"""Studies in processes that may be killed at any moment: the one that plans, those that train, or all."""

from __future__ import annotations

import os
import random
import signal
import time
from collections.abc import Iterator
from contextlib import suppress
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Literal, NoReturn

import pytest

from torchrl_her_recipes.config.study import Study
from torchrl_her_recipes.studies import workers
from torchrl_her_recipes.studies.study import StudyResult, run_study
from torchrl_her_recipes.studies.workers import LocalWorkers

from ...forks import fork
from .forked_worker import serve

Whom = Literal["parent", "worker", "both"]
WHOM: tuple[Whom, ...] = ("parent", "worker", "both")
_AT_ONCE = 2
_PATIENCE = 120.0  # seconds that a process may take to save what it has, on a machine that is busy


class Attempt:
    """One try to run a study in processes of its own.

    All of them hold one end of a pipe, so its other end tells when the last of them is gone.
    """

    def __init__(self, study: Study, folder: Path) -> None:
        self._reader, writer = Pipe(duplex=False)
        self._process = fork(_run, study, folder, writer)
        writer.close()
        self.folder = folder
        self.workers: list[int] = []
        self.result: StudyResult | None = None

    def kill(self, whom: Whom, *, after: float, draw: random.Random) -> bool:
        """Kills some of the processes after a while; returns whether there was still somebody to kill."""
        self._process.join(after)
        self._listen(0.0)
        if self._process.exitcode is not None:
            return False
        victims = draw.sample(self.workers, 1) if whom == "worker" and self.workers else self.workers
        if whom != "parent":
            if whom == "worker" and not victims:
                return False
            for pid in victims:
                with suppress(ProcessLookupError):  # it has ended, and nobody has its number yet
                    os.kill(pid, signal.SIGKILL)
        if whom != "worker":
            self._process.kill()
        return True

    def wait(self) -> bool:
        """Waits until no process is left; returns whether the study came to its end."""
        assert self._listen(_PATIENCE), f"there are processes left: {self.workers}"
        self._process.join(_PATIENCE)
        return self.result is not None and self.result.figure is not None

    def _listen(self, seconds: float) -> bool:
        """Hears what the processes say, for as long; returns whether all of them are gone."""
        until = time.monotonic() + seconds
        with suppress(EOFError):
            while self._reader.poll(max(until - time.monotonic(), 0.0)):
                said = self._reader.recv()
                if isinstance(said, int):
                    self.workers.append(said)
                else:
                    self.result = said
            return False
        return True


def _run(study: Study, folder: Path, writer: Connection) -> None:
    """The process of the study. Its workers are forks of it: new ones would take seconds to import torch."""
    os.setsid()
    spare = [_Fork(others) for others in _growing(_AT_ONCE + 2)]  # before there are threads here

    def next_fork(*_arguments: Any, **_options: Any) -> _Fork:
        own = spare.pop(0)
        writer.send(own.pid)
        return own

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(workers.subprocess, "Popen", next_fork)
        result = run_study(study, folder, workers=LocalWorkers(_AT_ONCE), progress=False)
    writer.send(result)


def _growing(count: int) -> Iterator[list[int]]:
    """As often, a list that whoever asks may make longer."""
    kept: list[int] = []
    for _ in range(count):
        yield kept


class _Fork:
    """As much of a ``subprocess.Popen`` as workers use.

    Args:
        others: the ends of other forks' pipes, which it must not hold; those of its own join them.
    """

    def __init__(self, others: list[int]) -> None:
        jobs, answers = os.pipe(), os.pipe()
        others += [jobs[1], answers[0]]
        self.pid = os.fork()
        if self.pid == 0:
            _serve(jobs[0], answers[1], others)
        os.close(jobs[0])
        os.close(answers[1])
        self.stdin, self.stdout = os.fdopen(jobs[1], "wb"), os.fdopen(answers[0], "rb")

    def kill(self) -> None:
        with suppress(ProcessLookupError):
            os.kill(self.pid, signal.SIGKILL)

    def wait(self) -> int:
        return os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])


def _serve(jobs: int, answers: int, others: list[int]) -> NoReturn:
    """A worker."""
    try:
        for own in others:
            os.close(own)
        serve(jobs, answers)
    finally:
        os._exit(0)
