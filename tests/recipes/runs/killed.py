"""Runs in processes that may be killed at any moment."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from torchrl_her_recipes import Recipe, build, cli
from torchrl_her_recipes.runs import run as running

from ...forks import fork


def is_killed(recipe: Recipe, folder: Path, *, after: float) -> bool:
    """Lets a process go on with a run; returns whether it was killed before it came to the end."""
    return was_killed(_go_on, recipe, folder, after=after)


def was_killed(target: Callable[..., Any], *args: Any, after: float) -> bool:
    """Calls a function in a process for some seconds; returns whether it was killed before its end."""
    process = fork(target, *args)
    process.join(after)
    process.kill()
    process.join()
    assert process.exitcode in (0, -signal.SIGKILL)
    return process.exitcode != 0


def _go_on(recipe: Recipe, folder: Path) -> None:
    if (folder / "config.yaml").exists():
        sys.exit(cli.main(["train", "--resume", str(folder)]))
    running.run(build(recipe), folder, progress=False)
