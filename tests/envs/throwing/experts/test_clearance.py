"""What is said to be in a ball's way is what it bounces off."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from torchrl_her_envs import BallPhysics, WorldConfig
from torchrl_her_envs.throwing.experts.clearance import clears_ceiling, clears_wall, is_free, will_hit

WORLD = WorldConfig()
N = 400


def flights(seed: int) -> tuple[Tensor, Tensor]:
    """Starts left of the wall and velocities to the right, [N, 2] each."""
    generator = torch.Generator().manual_seed(seed)
    u = torch.rand(N, 4, dtype=torch.float64, generator=generator)
    start = torch.stack((0.3 + 2.2 * u[:, 0], 0.4 + 5.0 * u[:, 1]), -1)
    return start, torch.stack((2.0 + 6.0 * u[:, 2], 10.0 * u[:, 3] - 4.0), -1)


def path(start: Tensor, velocity: Tensor, *, wall: bool) -> Tensor:
    """Where the balls are after 0 to 30 steps of the physics: [31, N, 2]."""
    physics, now, points = BallPhysics(len(start), WORLD, wall=wall), (start, velocity), [start]
    for _ in range(30):
        now = physics.step(*now)
        points.append(now[0])
    return torch.stack(points)


def test_flights_below_the_ceiling_are_those_that_do_not_bounce_off_it() -> None:
    start, velocity = flights(0)
    clear = clears_ceiling(start, velocity, WORLD)
    assert 0.1 < clear.double().mean() < 0.99
    top = WORLD.size * (1 - WORLD.ball_radius)
    highest = start[:, 1] + velocity[:, 1].clamp(min=0).square() / (2 * WORLD.gravity)
    assert (highest[clear] < top + 0.05).all()
    assert (highest[~clear] > top - 0.05).all()


def test_flights_over_the_wall_are_those_that_come_to_the_other_side() -> None:
    start, velocity = flights(1)
    clear = clears_wall(start, velocity, WORLD)
    assert 0.1 < clear.double().mean() < 0.9
    with_wall, without = (path(start, velocity, wall=wall) for wall in (True, False))
    middle = WORLD.wall_x * WORLD.size
    crosses = without[:, :, 0].gt(middle).long().argmax(0)  # the first step on the other side
    same, before_floor = [], []
    for k, step in enumerate(crosses):
        one, other = with_wall[: step + 2, k], without[: step + 2, k]
        same.append(bool((one - other).abs().max() < 1e-6))
        before_floor.append(bool((other[:, 1] > 0.25).all()))
    same, before_floor = torch.tensor(same), torch.tensor(before_floor)
    judged = before_floor & (crosses > 0) & clears_ceiling(start, velocity, WORLD)
    assert judged.sum() > 100
    assert (same[judged & clear]).all()
    assert (~same[judged & ~clear]).double().mean() > 0.97  # a few graze the corner


@pytest.mark.parametrize(
    ("point", "wall", "free"),
    [
        ((3.0, 2.0), True, False),
        ((3.0, 2.0), False, True),
        ((3.0, 3.3), True, True),
        ((0.17, 2.0), False, False),
        ((5.9, 2.0), False, False),
        ((2.0, 0.1), False, False),
        ((2.0, 5.9), False, False),
        ((2.0, 0.18), False, True),  # on the floor
    ],
)
def test_where_a_ball_touches_nothing(point: tuple[float, float], wall: bool, free: bool) -> None:
    assert bool(is_free(torch.tensor(point), WORLD, wall=wall)) is free


@pytest.mark.parametrize("wall", [False, True])
def test_balls_that_are_said_to_hit_do(wall: bool) -> None:
    start, velocity = flights(2)
    goal = torch.tensor([4.5, 2.5], dtype=torch.float64).expand(N, 2)
    hits = will_hit(start, velocity, goal, WORLD, wall=wall, within=0.4)
    assert hits.sum() > 10
    gap = (path(start, velocity, wall=wall)[1:] - goal).norm(dim=-1).amin(0)
    assert (gap[hits] < 0.4 + 1e-6).all()
    assert (gap[~hits] > 0.4 - 1e-6).double().mean() > 0.8  # the others may bounce into it
