"""The hand: moves freely within the left half of the screen, at the velocity that is asked for."""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_her_envs.throwing.tasks import WorldConfig


class Hand:
    """A hand that is its own grip; its joints are its position. See :class:`~.effector.Effector`.

    Args:
        world: the constants of the world.
        wall: whether there is a wall, which a held ball must not enter.

    Example:
        >>> hand = Hand(WorldConfig(), wall=False)
        >>> at, change = torch.tensor([[1.0, 1.0], [9.0, 0.5]], dtype=torch.float64)
        >>> hand.move(at, change).tolist()  # stays in its half
        [2.82, 1.5]
    """

    num_joints = 2
    observation_size = 5
    grip_index = (0, 1)

    def __init__(self, world: WorldConfig, *, wall: bool) -> None:
        margin = world.ball_radius
        right = world.wall_x - margin - (world.wall_thickness / 2 if wall else 0.0)
        self.reach = (margin, margin, right, 1.0 - margin)
        self.action_speed = world.hand_speed
        self._low = torch.tensor(self.reach[:2], dtype=torch.float64) * world.size
        self._high = torch.tensor(self.reach[2:], dtype=torch.float64) * world.size

    def sample(self, u: Tensor) -> Tensor:
        return self._low + u * (self._high - self._low)

    def move(self, joints: Tensor, change: Tensor) -> Tensor:
        return torch.clamp(joints + change, self._low.to(joints), self._high.to(joints))

    def grip(self, joints: Tensor) -> Tensor:
        return joints

    def observe(
        self, joints: Tensor, speed: Tensor, grip: Tensor, grip_speed: Tensor, closed: Tensor
    ) -> Tensor:
        return torch.cat((grip, grip_speed, closed), -1)

    def skeleton(self, joints: Tensor) -> Tensor:
        return joints.unsqueeze(-2)
