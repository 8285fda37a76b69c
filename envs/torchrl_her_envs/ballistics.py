"""Flight of a thrown ball until it first touches anything. Pure functions, any batch shape.

They follow the steps of the physics, not the parabola: in each substep h a ball moves on by v h and is
slowed by g h afterwards, so that after m substeps it has fallen by g h^2 m (m - 1) / 2. Points and
velocities are [..., 2] in metres and metres a second.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_her_envs.task import WorldConfig

_SLOP = 1e-3  # metres that a ball may sink into a side without bouncing: rounding, and Chipmunk's own slop


def fallen(substeps: Tensor, world: WorldConfig) -> Tensor:
    """How far gravity has drawn a ball off its straight line.

    Args:
        substeps: [...], number of substeps flown; may be fractional.
        world: the constants of the world.

    Returns:
        [...] in metres, downwards.

    Example:
        >>> fallen(torch.tensor([1.0, 4.0]), WorldConfig())
        tensor([0.0000, 0.0060])
    """
    h = world.time_step / world.substeps
    return 0.5 * world.gravity * h**2 * substeps * (substeps - 1.0)


def fly(start: Tensor, velocity: Tensor, substeps: Tensor, world: WorldConfig) -> Tensor:
    """Where a ball is after a while of free flight.

    Args:
        start: [..., 2].
        velocity: [..., 2].
        substeps: [...], broadcast against ``start[..., 0]``.
        world: the constants of the world.

    Returns:
        [..., 2].

    Example:
        >>> fly(torch.tensor([1.0, 2.0]), torch.tensor([3.0, 0.0]), torch.tensor(4.0), WorldConfig())
        tensor([1.1200, 1.9940])
    """
    h = world.time_step / world.substeps
    point = start + velocity * (h * substeps.unsqueeze(-1))
    return torch.stack((point[..., 0], point[..., 1] - fallen(substeps, world)), -1)


def throw_velocity(start: Tensor, target: Tensor, steps: Tensor, world: WorldConfig) -> Tensor:
    """The velocity of a hand that swings for one step, lets go, and so sends a ball to a target.

    Args:
        start: [..., 2], where the swing of one step begins.
        target: [..., 2], where the ball shall be ``steps`` time steps after the end of the swing.
        steps: [...], at least 1.
        world: the constants of the world.

    Returns:
        [..., 2].

    Example:
        >>> world, start, goal = WorldConfig(), torch.tensor([2.0, 3.0]), torch.tensor([4.0, 2.5])
        >>> velocity = throw_velocity(start, goal, torch.tensor(10.0), world)
        >>> fly(start + velocity * world.time_step, velocity, torch.tensor(40.0), world)
        tensor([4.0000, 2.5000])
    """
    drop = fallen(steps * world.substeps, world)
    gap = target - start
    way = torch.stack(torch.broadcast_tensors(gap[..., 0], gap[..., 1] + drop), -1)
    return way / (world.time_step * (steps + 1.0)).unsqueeze(-1)


def peak(start: Tensor, velocity: Tensor, world: WorldConfig) -> Tensor:
    """The greatest height [...] of a flight.

    Example:
        >>> peak(torch.tensor([0.0, 1.0]), torch.tensor([2.0, 4.0]), WorldConfig()) # 1 + 4^2 / 20, and 1 cm
        tensor(1.8201)
    """
    h = world.time_step / world.substeps
    top = (velocity[..., 1] / (world.gravity * h) + 0.5).clamp(min=0.0)
    return start[..., 1] + velocity[..., 1] * h * top - fallen(top, world)


def wall_box(world: WorldConfig) -> tuple[float, float, float]:
    """Left, right and top, in metres, of where the wall keeps the centre of a ball out."""
    radius, half = world.ball_radius, world.wall_thickness / 2
    return (
        (world.wall_x - half - radius) * world.size,
        (world.wall_x + half + radius) * world.size,
        (world.wall_height + radius) * world.size,
    )


def clears_wall(start: Tensor, velocity: Tensor, world: WorldConfig) -> Tensor:
    """Whether a flight to the right, from left of the wall, passes above it: [...] of bool.

    A parabola that is above both upper corners is above all between them.
    """
    left, right, top = wall_box(world)
    h = world.time_step / world.substeps
    speed = velocity[..., 0].clamp(min=1e-6)

    def above(x: float) -> Tensor:
        return fly(start, velocity, (x - start[..., 0]) / (speed * h), world)[..., 1] > top

    return above(left) & above(right)


def is_free(points: Tensor, world: WorldConfig, *, wall: bool) -> Tensor:
    """Whether a ball at these points touches nothing: [...] of bool for [..., 2].

    Example:
        >>> points = torch.tensor([[3.0, 2.0], [3.0, 4.0], [0.1, 4.0]])  # in the wall, above it, in the side
        >>> is_free(points, WorldConfig(), wall=True)
        tensor([False,  True, False])
    """
    radius = world.ball_radius * world.size - _SLOP
    free = ((points > radius) & (points < world.size - radius)).all(-1)
    if wall:
        left, right, top = wall_box(world)
        x, y = points.unbind(-1)
        free &= (x <= left + _SLOP) | (x >= right) | (y >= top)
    return free


def will_hit(
    start: Tensor, velocity: Tensor, goal: Tensor, world: WorldConfig, *, wall: bool, within: float, steps: int
) -> Tensor:
    """Whether a ball that is left to itself comes to a goal before it touches anything.

    Args:
        start: [..., 2], of the ball.
        velocity: [..., 2], of the ball.
        goal: [..., 2].
        world: the constants of the world.
        wall: whether there is one.
        within: how near to the goal, in metres, the ball must be at the end of a time step.
        steps: the longest flight, in time steps.

    Returns:
        [...] of bool.

    Example:
        >>> goal, world = torch.tensor([4.0, 2.5]), WorldConfig()
        >>> start, velocity = torch.tensor([2.18, 3.13]), torch.tensor([4.55, 0.4])
        >>> bool(will_hit(start, velocity, goal, world, wall=False, within=0.3, steps=30))
        True
    """
    substeps = torch.arange(1, steps * world.substeps + 1, dtype=start.dtype, device=start.device)
    points = fly(start.unsqueeze(-2), velocity.unsqueeze(-2), substeps, world)
    untouched = is_free(points, world, wall=wall).cummin(-1).values
    near = (points - goal.unsqueeze(-2)).square().sum(-1) < within**2
    last = slice(world.substeps - 1, None, world.substeps)  # goals are looked at between time steps only
    return (untouched & near)[..., last].any(-1)
