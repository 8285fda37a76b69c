"""Checks whether a ball flies clear of obstacles. Pure functions, any batch shape.

Points and velocities are [..., 2] in meters and meters a second.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_her_envs.throwing.experts.ballistics import LONGEST_FLIGHT, fly
from torchrl_her_envs.throwing.tasks import WorldConfig

_SLOP = 1e-3  # meters that a ball may sink into a side without bouncing: rounding, and Chipmunk's own slop


def clears_ceiling(start: Tensor, velocity: Tensor, world: WorldConfig) -> Tensor:
    """Returns a mask [...] of the flights whose highest point is below the ceiling.

    Example:
        >>> start, velocity = torch.tensor([0.0, 4.9]), torch.tensor([[0.0, 4.0], [0.0, 5.0]])
        >>> clears_ceiling(start, velocity, WorldConfig())  # rise by 0.8 m and by 1.25 m; 0.92 m are free
        tensor([ True, False])
    """
    loss = world.gravity * world.time_step / world.substeps  # loss of upward speed in each substep
    rising = (velocity[..., 1] / loss + 0.5).clamp(min=0.0)
    return fly(start, velocity, rising, world)[..., 1] < (1.0 - world.ball_radius) * world.size


def clears_wall(start: Tensor, velocity: Tensor, world: WorldConfig) -> Tensor:
    """Returns a mask [...] of the flights, from left of the wall to the right, that pass above the wall.

    A parabola that is above both upper corners is above all between them.

    Example:
        >>> start, velocity = torch.tensor([2.5, 3.0]), torch.tensor([[5.0, 4.0], [5.0, 1.0]])
        >>> clears_wall(start, velocity, WorldConfig())
        tensor([ True, False])
    """
    left, right, top = _wall_box(world)
    stride = velocity[..., 0].clamp(min=1e-6) * (world.time_step / world.substeps)

    def above(x: float) -> Tensor:
        return fly(start, velocity, (x - start[..., 0]) / stride, world)[..., 1] > top

    return above(left) & above(right)


def is_free(points: Tensor, world: WorldConfig, *, wall: bool) -> Tensor:
    """Returns a mask [...] of the points [..., 2] at which a ball touches nothing.

    Example:
        >>> points = torch.tensor([[3.0, 2.0], [3.0, 4.0], [0.1, 4.0]])  # in the wall, above it, in the side
        >>> is_free(points, WorldConfig(), wall=True)
        tensor([False,  True, False])
    """
    radius = world.ball_radius * world.size - _SLOP
    free = ((points > radius) & (points < world.size - radius)).all(-1)
    if wall:
        left, right, top = _wall_box(world)
        x, y = points.unbind(-1)
        free &= (x <= left + _SLOP) | (x >= right) | (y >= top)
    return free


def will_hit(
    start: Tensor, velocity: Tensor, goal: Tensor, world: WorldConfig, *, wall: bool, within: float
) -> Tensor:
    """Returns whether a ball in free flight reaches a goal before it touches anything.

    Args:
        start: [..., 2], position of the ball.
        velocity: [..., 2], velocity of the ball.
        goal: [..., 2], position of the goal.
        world: the constants of the world.
        wall: whether there is a wall.
        within: how near to the goal, in meters, the ball must be at the end of a time step.

    Returns:
        Mask [...] of the balls that reach their goal.

    Example:
        >>> goal, world = torch.tensor([4.0, 2.5]), WorldConfig()
        >>> start, velocity = torch.tensor([2.18, 3.13]), torch.tensor([4.55, 0.4])
        >>> bool(will_hit(start, velocity, goal, world, wall=False, within=0.3))
        True
    """
    substeps = torch.arange(1, LONGEST_FLIGHT * world.substeps + 1, dtype=start.dtype, device=start.device)
    points = fly(start.unsqueeze(-2), velocity.unsqueeze(-2), substeps, world)
    untouched = is_free(points, world, wall=wall).cummin(-1).values
    near = (points - goal.unsqueeze(-2)).square().sum(-1) < within**2
    last = slice(world.substeps - 1, None, world.substeps)  # goals are checked after each time step only
    return (untouched & near)[..., last].any(-1)


def _wall_box(world: WorldConfig) -> tuple[float, float, float]:
    """Returns left, right and top, in meters, of the box that the center of a ball cannot enter."""
    radius, half = world.ball_radius, world.wall_thickness / 2
    return (
        (world.wall_x - half - radius) * world.size,
        (world.wall_x + half + radius) * world.size,
        (world.wall_height + radius) * world.size,
    )
