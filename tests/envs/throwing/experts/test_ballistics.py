"""Flights that are computed are those that the physics make."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_her_envs import BallPhysics, WorldConfig
from torchrl_her_envs.throwing.experts.ballistics import fallen, fly, quickest, throw_velocity

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


def test_nothing_has_fallen_in_no_or_one_substep() -> None:
    assert fallen(torch.tensor([0.0, 1.0]), WORLD).tolist() == [0.0, 0.0]


@settings(max_examples=30, deadline=None)
@given(st.floats(0.2, 5.8), st.floats(0.2, 5.8), st.floats(0.2, 5.8), st.floats(0.2, 5.8), st.integers(1, 30))
def test_a_throw_comes_to_its_target(x: float, y: float, to_x: float, to_y: float, steps: int) -> None:
    start, target = (torch.tensor(point, dtype=torch.float64) for point in ((x, y), (to_x, to_y)))
    flight = torch.tensor(steps, dtype=torch.float64)
    velocity = throw_velocity(start, target, flight, WORLD)
    launch = start + velocity * WORLD.time_step
    arrived = fly(launch, velocity, flight * WORLD.substeps, WORLD)
    torch.testing.assert_close(arrived, target, atol=1e-9, rtol=0)


def test_the_quickest_throw_that_works_is_found_in_every_dimension() -> None:
    steps = torch.tensor([[[3.0, 1.0], [2.0, 9.0]]]).repeat(3, 1, 1)
    works = torch.tensor([[[1, 1], [1, 1]], [[1, 0], [1, 1]], [[0, 0], [0, 1]]], dtype=torch.bool)
    assert [index.tolist() for index in quickest(steps, works)] == [[0, 1, 1], [1, 0, 1]]
    assert [index.tolist() for index in quickest(steps, torch.zeros_like(works))] == [[0] * 3] * 2
