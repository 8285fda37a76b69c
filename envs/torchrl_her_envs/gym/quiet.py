"""Makes gymnasium environments without the lines that their simulators print."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from typing import TYPE_CHECKING, Any

import gymnasium
from gymnasium.envs.registration import EnvSpec

from torchrl_her_envs.gym.renamed import RenamedKeys

if TYPE_CHECKING:  # each process of an environment imports this file, and loading TorchRL takes seconds
    from torchrl_her_envs.common.goal_env import Names


def make_quietly(
    id: str | EnvSpec, names: Mapping[str, Names] | None = None, /, **options: Any
) -> gymnasium.Env:
    """Calls ``gymnasium.make``, and suppresses the arguments that PyBullet prints for each environment.

    Args:
        id: id of the environment.
        names: names of its entries, see :class:`~torchrl_her_envs.gym.renamed.RenamedKeys`; None for
            GoalEnv's own names.
        options: options of the environment.
    """
    with _python_alone():
        env = gymnasium.make(id, disable_env_checker=True, **options)
    return env if names is None else RenamedKeys(env, names)


@contextmanager
def _python_alone() -> Iterator[None]:
    """Discards output of compiled code; Python and debuggers still print."""
    sys.stdout.flush()
    with os.fdopen(os.dup(1), "w", buffering=1) as terminal:
        with open(os.devnull, "w") as nothing:
            os.dup2(nothing.fileno(), 1)
        try:
            with redirect_stdout(terminal if sys.stdout is sys.__stdout__ else sys.stdout):
                yield
        finally:
            os.dup2(terminal.fileno(), 1)
