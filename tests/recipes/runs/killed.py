"""Runs in processes that may be killed at any moment."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable
from functools import cache
from multiprocessing import get_context
from multiprocessing.context import ForkServerContext
from pathlib import Path
from typing import Any

import pytest

from torchrl_her_recipes import Recipe, build, cli
from torchrl_her_recipes.runs import run as running

_ROOT = Path(__file__).parents[3]


def is_killed(recipe: Recipe, folder: Path, *, after: float) -> bool:
    """Lets a process go on with a run; returns whether it was killed before it came to the end."""
    return was_killed(_go_on, recipe, folder, after=after)


def was_killed(target: Callable[..., Any], *args: Any, after: float) -> bool:
    """Lets a process do something for some seconds; returns whether it was killed before it came to the end.

    Not a fork of the tests' process: it would be born with the locks that other threads there hold (Ray's,
    progress bars'), and share some with all other forks, which a killed one never gives back.
    """
    process = server().Process(target=target, args=args)
    process.start()
    process.join(after)
    process.kill()
    process.join()
    assert process.exitcode in (0, -signal.SIGKILL)
    return process.exitcode != 0


@cache
def server() -> ForkServerContext:
    """Forks processes that have imported all there is, and nothing else; it is up when this returns."""
    context = get_context("forkserver")
    context.set_forkserver_preload([__name__])
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(_ROOT)
        first = context.Process(target=_nothing)
        first.start()
        first.join()
    assert first.exitcode == 0
    return context


def _nothing() -> None:
    """Runs when all is imported."""


def _go_on(recipe: Recipe, folder: Path) -> None:
    if (folder / "config.yaml").exists():
        sys.exit(cli.main(["train", "--resume", str(folder)]))
    running.run(build(recipe), folder, progress=False)
