"""A process for what starts worker processes: whatever happens there, all of them end with it."""

from __future__ import annotations

import os
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import multiprocessing

from ...forks import call_in_session
from .buffers import try_ray, try_remote
from .collect import SOURCES
from .fill import share

_SECONDS = 400  # until a job that hangs is ended

JOBS: dict[str, Callable[..., Any]] = {
    "collect": lambda source, env_ids: SOURCES[source].collect(env_ids=env_ids),
    "share": share,
    "remote": try_remote,
    "ray": try_ray,
}


def run_jobs(jobs: Sequence[tuple[Any, ...]], *, start: str = "fork") -> list[tuple[Any, str]]:
    """Does some of JOBS in another process, one after the other.

    Args:
        jobs: of each, its name and its arguments.
        start: how workers are started.

    Returns:
        For each job ``(result, said)``: what it returned, or None if it failed, and what it and its workers
        wrote to the standard error.
    """
    with tempfile.TemporaryDirectory() as folder:
        call_in_session(_main, folder, start, jobs, seconds=_SECONDS * len(jobs))
        return [_outcome(Path(folder), number) for number in range(len(jobs))]


def _outcome(folder: Path, number: int) -> tuple[Any, str]:
    out = folder / f"{number}.pt"
    result = torch.load(out, weights_only=False) if out.exists() else None
    return result, (folder / f"{number}.txt").read_text()


def _main(folder: str, start: str, jobs: Sequence[tuple[Any, ...]]) -> None:
    """Does each job in a process that is forked from this one, which has no threads."""
    torch.set_num_threads(1)
    multiprocessing.set_start_method(start, force=True)  # TorchRL sets another one when it is imported
    for number, job in enumerate(jobs):
        if (process := os.fork()) == 0:
            _do(f"{folder}/{number}", *job)
        deadline = time.monotonic() + _SECONDS
        while os.waitpid(process, os.WNOHANG) == (0, 0):
            if time.monotonic() > deadline:
                os.kill(process, signal.SIGKILL)
            time.sleep(0.01)


def _do(out: str, name: str, *arguments: Any) -> None:
    with open(f"{out}.txt", "w") as said:
        os.dup2(said.fileno(), sys.stderr.fileno())
        try:
            torch.save(JOBS[name](*arguments), f"{out}.pt")
        except Exception:
            traceback.print_exc()
        finally:
            sys.stderr.flush()
            for worker in multiprocessing.active_children():
                worker.kill()
                worker.join()
            os._exit(0)  # threads of queues would wait for workers that are gone
