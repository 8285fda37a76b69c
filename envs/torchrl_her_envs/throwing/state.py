"""The state of N throwing environments: everything that changes from step to step."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass
class WorldState:
    """The state of N environments in meters, radians and seconds. Every tensor has N rows.

    ``free`` is whether the ball obeys physics: not while it is held, and in the robot's tasks not before it
    was held for the first time. ``step`` counts the steps of the episode, ``episode`` the resets. The tensors
    share memory with the arrays that steps write to, so writing to them changes the environments.
    """

    joints: Tensor
    joint_velocity: Tensor
    grip: Tensor
    grip_velocity: Tensor
    ball: Tensor
    ball_velocity: Tensor
    goal: Tensor
    closed: Tensor
    held: Tensor
    free: Tensor
    step: Tensor
    episode: Tensor
