"""Processes that are forked from one that has imported all there is, which takes seconds only once."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from multiprocessing import Pipe, get_context
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerContext, ForkServerProcess
from pathlib import Path
from threading import Lock
from typing import Any

import pytest

_ROOT = Path(__file__).parents[1]
_STARTING = Lock()  # pytest clears the cache of imports, which fails if two threads do so at once
_IMPORTED = [
    "pandas",
    "torch.utils.tensorboard",
    "torchrl_her_envs.throwing.env",
    "torchrl_her_recipes.cli",
    "torchrl_her_recipes.components",
    "torchrl_her_recipes.runs.run",
    "torchrl_her_recipes.studies.study",
    "tests.frozen",
]


@cache
def server() -> ForkServerContext:
    """Starts what forks processes; it has imported everything when this returns.

    Processes are no forks of the tests' process: they would be born with the locks that other threads there
    hold (Ray's, progress bars'), and share some with all other forks, which a killed one never gives back.
    """
    context = get_context("forkserver")
    context.set_forkserver_preload(_IMPORTED)
    first = _started(context, _nothing)
    first.join()
    assert first.exitcode == 0
    return context


def fork(target: Callable[..., Any], *args: Any) -> ForkServerProcess:
    """Starts a process that calls a function."""
    return _started(server(), target, *args)


def result_of(function: Callable[..., Any], *args: Any) -> Any:
    """What a function returns in a new process."""
    reader, writer = Pipe(duplex=False)
    process = fork(_send_result, writer, function, args)
    writer.close()
    with reader:
        result = reader.recv()
    process.join()
    return result


def call_in_session(target: Callable[..., Any], *args: Any, seconds: float) -> None:
    """Calls a function in a new session, and kills all processes that are left there when it returns.

    Args:
        seconds: Time limit of the call.
    """
    process = fork(_lead_session, target, args)
    try:
        process.join(seconds)
    finally:
        with suppress(ProcessLookupError):  # all of them ended by themselves
            os.killpg(process.pid or 0, signal.SIGKILL)
        process.join()


def _started(context: ForkServerContext, target: Callable[..., Any], *args: Any) -> ForkServerProcess:
    process = context.Process(target=target, args=args)
    with _STARTING, pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(_ROOT)  # which the new process copies
        process.start()
    return process


def _nothing() -> None:
    """Runs when all is imported."""


def _send_result(writer: Connection, function: Callable[..., Any], args: tuple[Any, ...]) -> None:
    writer.send(function(*args))


def _lead_session(target: Callable[..., Any], args: tuple[Any, ...]) -> None:
    os.setsid()
    target(*args)
