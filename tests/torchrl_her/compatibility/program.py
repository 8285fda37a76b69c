"""A process for what starts worker processes: whatever happens there, all of them end with it.

Workers are forked, which takes a second instead of the ten of TorchRL's own way.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import multiprocessing

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
        command = [sys.executable, "-m", __name__, folder, start, json.dumps(jobs)]
        with subprocess.Popen(
            command, cwd=Path(__file__).parents[3], stdout=subprocess.DEVNULL, start_new_session=True
        ) as program:
            try:
                program.wait()
            finally:
                with contextlib.suppress(ProcessLookupError):  # all of them ended by themselves
                    os.killpg(program.pid, signal.SIGKILL)
        return [_outcome(Path(folder), number) for number in range(len(jobs))]


def _outcome(folder: Path, number: int) -> tuple[Any, str]:
    out = folder / f"{number}.pt"
    result = torch.load(out, weights_only=False) if out.exists() else None
    return result, (folder / f"{number}.txt").read_text()


def main(folder: str, start: str, jobs: str) -> None:
    """The program: each job in a process that is forked from this one, which has no threads."""
    torch.set_num_threads(1)
    multiprocessing.set_start_method(start, force=True)  # TorchRL sets another one when it is imported
    for number, job in enumerate(json.loads(jobs)):
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


if __name__ == "__main__":
    main(*sys.argv[1:])
