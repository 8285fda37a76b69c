"""The hand: moves freely within the left half of the screen, at the velocity that the action sets."""

from __future__ import annotations

import numpy as np

from torchrl_her_envs.throwing.arrays import Array, confined, like
from torchrl_her_envs.throwing.tasks import WorldConfig


class Hand:
    """A hand, whose position serves both as joints and as grip. See :class:`~.effector.Effector`.

    Args:
        world: the constants of the world.
        wall: whether there is a wall, which a held ball must not enter.

    Example:
        >>> import torch
        >>> hand = Hand(WorldConfig(), wall=False)
        >>> at, change = torch.tensor([[1.0, 1.0], [9.0, 0.5]], dtype=torch.float64)
        >>> hand.move(at, change).tolist()  # stays in its half
        [2.82, 1.5]
    """

    num_joints = 2
    # A hand's joints are its grip, so only the grip is observed.
    shown: tuple[str, ...] = ("grip", "grip_velocity", "closed")
    observation_size = 5
    grip_index = (0, 1)

    def __init__(self, world: WorldConfig, *, wall: bool) -> None:
        margin = world.ball_radius
        right = world.wall_x - margin - (world.wall_thickness / 2 if wall else 0.0)
        self.reach = (margin, margin, right, 1.0 - margin)
        self.action_speed = world.hand_speed
        self._low = np.array(self.reach[:2]) * world.size
        self._high = np.array(self.reach[2:]) * world.size
        self._ends = list(zip(self._low.tolist(), self._high.tolist(), strict=True))

    def sample(self, u: Array) -> Array:
        return like(self._low, u) + u * like(self._high - self._low, u)

    def move(self, joints: Array, change: Array) -> Array:
        return confined(joints + change, like(self._low, joints), like(self._high, joints))

    def move_one(self, joints: list[float], change: list[float]) -> list[float]:
        return [confined(at + by, *ends) for at, by, ends in zip(joints, change, self._ends, strict=True)]

    def grip(self, joints: Array) -> Array:
        return joints

    def grip_one(self, joints: list[float]) -> list[float]:
        return joints

    def skeleton(self, joints: Array) -> Array:
        return joints[..., None, :]
