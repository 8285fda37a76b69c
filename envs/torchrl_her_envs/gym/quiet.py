"""Makes environments of gymnasium's without the lines that their simulators print."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from typing import Any

import gymnasium
from gymnasium.envs.registration import EnvSpec


def make_quietly(id: str | EnvSpec, **options: Any) -> gymnasium.Env:
    """Calls ``gymnasium.make``; PyBullet prints its arguments for each environment, which is left out."""
    with _python_alone():
        return gymnasium.make(id, disable_env_checker=True, **options)


@contextmanager
def _python_alone() -> Iterator[None]:
    """Discards what compiled code writes to the standard output; Python still prints, and debuggers do."""
    sys.stdout.flush()
    with os.fdopen(os.dup(1), "w", buffering=1) as terminal:
        with open(os.devnull, "w") as nothing:
            os.dup2(nothing.fileno(), 1)
        try:
            with redirect_stdout(terminal if sys.stdout is sys.__stdout__ else sys.stdout):
                yield
        finally:
            os.dup2(terminal.fileno(), 1)
