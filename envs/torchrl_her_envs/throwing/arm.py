"""The arm: a chain of equal links whose joints turn at the velocity that is asked for."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchrl_her_envs.throwing.kinematics import chain
from torchrl_her_envs.throwing.tasks import WorldConfig


class Arm:
    """A planar arm; its joints are its angles in radians. See :class:`~.effector.Effector`.

    Args:
        world: the constants of the world.
        num_links: number of equal links.

    Raises:
        ValueError: ``num_links`` is below 1.

    Example:
        >>> arm = Arm(WorldConfig(), num_links=2)
        >>> arm.grip(torch.zeros(2, dtype=torch.float64)).tolist()  # stretched to the right
        [3.98, 3.0]
    """

    def __init__(self, world: WorldConfig, *, num_links: int = 2) -> None:
        if num_links < 1:
            raise ValueError(f"an arm needs at least 1 link, got num_links={num_links}")
        self.num_joints = num_links
        self.observation_size = 3 * num_links + 5
        self.grip_index = (2 * num_links, 2 * num_links + 1)
        self.action_speed = world.joint_speed
        length = world.arm_length / world.size
        x, y = world.arm_base
        self.reach = (x - length, y - length, x + length, y + length)
        self._length = world.arm_length
        self._base = torch.tensor(world.arm_base, dtype=torch.float64) * world.size
        self._start = (math.radians(world.arm_start[0]), math.radians(world.arm_start[1]))

    def sample(self, u: Tensor) -> Tensor:
        return self._start[0] + u * (self._start[1] - self._start[0])

    def move(self, joints: Tensor, change: Tensor) -> Tensor:
        return joints + change

    def grip(self, joints: Tensor) -> Tensor:
        return self.skeleton(joints)[..., -1, :]

    def observe(
        self, joints: Tensor, speed: Tensor, grip: Tensor, grip_speed: Tensor, closed: Tensor
    ) -> Tensor:
        return torch.cat((joints.cos(), joints.sin(), grip, speed, grip_speed, closed), -1)

    def skeleton(self, joints: Tensor) -> Tensor:
        return chain(joints, self._base.to(joints), self._length)
