"""Flights that are computed are those that the physics make."""

from __future__ import annotations

import pytest
import torch

from torchrl_her_envs import BallPhysics, WorldConfig
from torchrl_her_envs.throwing.experts.ballistics import fly

WORLD = WorldConfig()


@pytest.mark.parametrize("steps", [1, 3, 8])
@pytest.mark.parametrize("velocity", [(3.0, 2.0), (-4.0, 0.0), (0.0, -1.0), (5.0, 5.0)])
def test_a_flight_is_the_one_that_the_physics_make(steps: int, velocity: tuple[float, float]) -> None:
    start = torch.tensor([[3.0, 3.0]], dtype=torch.float64)
    speed = torch.tensor([velocity], dtype=torch.float64)
    physics, now = BallPhysics(1, WORLD, wall=False), (start, speed)
    for _ in range(steps):
        now = physics.step(*now)
    substeps = torch.tensor([steps * WORLD.substeps], dtype=torch.float64)
    torch.testing.assert_close(fly(start, speed, substeps, WORLD), now[0], atol=1e-9, rtol=0)
