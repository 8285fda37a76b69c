"""The arm: a chain of equal links whose joints turn at the velocity that the action sets."""

from __future__ import annotations

import math

import numpy as np

from torchrl_her_envs.throwing.arrays import Array, like
from torchrl_her_envs.throwing.kinematics import chain, chain_end, walk
from torchrl_her_envs.throwing.tasks import WorldConfig


class Arm:
    """A planar arm; its joints are its angles in radians. See :class:`~.effector.Effector`.

    Args:
        world: the constants of the world.
        num_links: number of equal links.

    Raises:
        ValueError: ``num_links`` is below 1.

    Example:
        >>> import torch
        >>> arm = Arm(WorldConfig(), num_links=2)
        >>> arm.grip(torch.zeros(2, dtype=torch.float64)).tolist()  # stretched to the right
        [3.98, 3.0]
    """

    def __init__(self, world: WorldConfig, *, num_links: int = 2) -> None:
        if num_links < 1:
            raise ValueError(f"an arm needs at least 1 link, got num_links={num_links}")
        self.num_joints = num_links
        velocities = ("joint_velocity", "grip_velocity")
        self.shown: tuple[str, ...] = ("cosines", "sines", "grip", *velocities, "closed")
        self.observation_size = 3 * num_links + 5
        self.grip_index = (2 * num_links, 2 * num_links + 1)
        self.action_speed = world.joint_speed
        length = world.arm_length / world.size
        x, y = world.arm_base
        self.reach = (x - length, y - length, x + length, y + length)
        self._length = world.arm_length
        self._base = np.array(world.arm_base) * world.size
        self._base_one = self._base.tolist()
        self._start = (math.radians(world.arm_start[0]), math.radians(world.arm_start[1]))

    def sample(self, u: Array) -> Array:
        return self._start[0] + u * (self._start[1] - self._start[0])

    def move(self, joints: Array, change: Array) -> Array:
        return joints + change

    def move_one(self, joints: list[float], change: list[float]) -> list[float]:
        return [at + by for at, by in zip(joints, change, strict=True)]

    def grip(self, joints: Array) -> Array:
        return chain_end(joints, like(self._base, joints), self._length)

    def grip_one(self, joints: list[float]) -> list[float]:
        *_, (x, y) = walk(joints, self._base_one, self._length / len(joints))
        return [x, y]

    def skeleton(self, joints: Array) -> Array:
        return chain(joints, like(self._base, joints), self._length)
