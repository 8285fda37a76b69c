"""The state of N throwing environments: everything that changes from step to step."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass
class WorldState:
    """The state of N environments in meters, radians and seconds. Every tensor has N rows.

    ``free`` says that the ball obeys physics (not while it is held, and the robot's not before it was
    held for the first time). ``step`` counts the steps of the episode, ``episode`` the resets. The tensors
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

    @classmethod
    def zeros(cls, num_envs: int, num_joints: int) -> WorldState:
        """N environments before their first reset."""

        def points(n: int) -> Tensor:
            return torch.zeros(num_envs, n, dtype=torch.float64)

        def flags(dtype: torch.dtype) -> Tensor:
            return torch.zeros(num_envs, dtype=dtype)

        return cls(
            points(num_joints),
            points(num_joints),
            *(points(2) for _ in range(5)),
            *(flags(torch.bool) for _ in range(3)),
            *(flags(torch.int64) for _ in range(2)),
        )
