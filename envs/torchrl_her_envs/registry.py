"""Environments by name."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from torchrl_her_envs.small_worlds import BitFlip, Chain, SmallWorld, TreasureHunt
from torchrl_her_envs.task import TASKS, Task, WorldConfig
from torchrl_her_envs.throwing import ThrowingEnv

SMALL_WORLDS: dict[str, type[SmallWorld]] = {
    "bit_flip": BitFlip,
    "treasure_hunt": TreasureHunt,
    "chain": Chain,
}


def get_task(name: str) -> Task:
    """The task of a name.

    Raises:
        ValueError: there is none; the message lists those that there are.

    Example:
        >>> get_task("robot_v1").effector
        'arm'
    """
    if name not in TASKS:
        raise ValueError(f"unknown task {name!r}; the tasks are {', '.join(TASKS)}")
    return TASKS[name]


def make_env(
    name: str,
    *,
    num_envs: int = 1,
    seed: int | Sequence[int] = 0,
    world: WorldConfig | None = None,
    num_links: int = 2,
    threshold: float | None = None,
    dtype: torch.dtype = torch.float32,
) -> ThrowingEnv:
    """Makes a batch of worlds of a task.

    Args:
        name: one of :data:`~torchrl_her_envs.TASKS`.
        num_envs: number of worlds.
        seed: of all random starts and goals; R seeds for R equal blocks of worlds, each as if alone.
        world: the constants of the world, to change them.
        num_links: of the arm, for the robot's tasks.
        threshold: how near to the goal is achieved, in shown coordinates; the task's if None.
        dtype: of what the agent sees and does.

    Raises:
        ValueError: an unknown name, a number below 1, or a threshold that is not positive.

    Example:
        >>> env = make_env("hand_v0", num_envs=2, seed=0)
        >>> env.reset()["observation"].shape
        torch.Size([2, 9])
    """
    return ThrowingEnv(
        get_task(name),
        num_envs=num_envs,
        seed=seed,
        world=world,
        num_links=num_links,
        threshold=threshold,
        dtype=dtype,
    )
