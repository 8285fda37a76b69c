"""Throws, and the free flight of a ball. Pure functions, any batch shape.

The functions follow the steps of the physics, not the parabola: in each substep h a ball moves by v h and is
then slowed by g h, so that after m substeps it has fallen by g h^2 m (m - 1) / 2. Points and velocities are
[..., 2] in meters and meters a second.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_her_envs.throwing.tasks import WorldConfig

LONGEST_FLIGHT = 30  # number of steps that controllers look ahead: in 1.2 s a ball falls from top to bottom


def fallen(substeps: Tensor, world: WorldConfig) -> Tensor:
    """Returns how far gravity has drawn a ball off its straight line.

    Args:
        substeps: [...], number of substeps flown; may be fractional.
        world: the constants of the world.

    Returns:
        Distances [...] in meters, downwards.

    Example:
        >>> fallen(torch.tensor([1.0, 4.0]), WorldConfig())
        tensor([0.0000, 0.0060])
    """
    h = world.time_step / world.substeps
    return 0.5 * world.gravity * h**2 * substeps * (substeps - 1.0)


def fly(start: Tensor, velocity: Tensor, substeps: Tensor, world: WorldConfig) -> Tensor:
    """Returns the position of a ball after some time of free flight.

    Args:
        start: [..., 2], position at the beginning.
        velocity: [..., 2], velocity at the beginning.
        substeps: [...], number of substeps flown, broadcast against ``start[..., 0]``.
        world: the constants of the world.

    Returns:
        Positions [..., 2].

    Example:
        >>> fly(torch.tensor([1.0, 2.0]), torch.tensor([3.0, 0.0]), torch.tensor(4.0), WorldConfig())
        tensor([1.1200, 1.9940])
    """
    h = world.time_step / world.substeps
    point = start + velocity * (h * substeps.unsqueeze(-1))
    return torch.stack((point[..., 0], point[..., 1] - fallen(substeps, world)), -1)


def throw_velocity(start: Tensor, target: Tensor, steps: Tensor, world: WorldConfig) -> Tensor:
    """Computes the velocity of a hand that swings for one step and lets go, so that the ball hits a target.

    Args:
        start: [..., 2], where the swing of one step begins.
        target: [..., 2], where the ball should be ``steps`` time steps after the end of the swing.
        steps: [...], time steps of the flight, at least 1.
        world: the constants of the world.

    Returns:
        Velocities [..., 2].

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


def quickest(steps: Tensor, works: Tensor) -> tuple[Tensor, ...]:
    """Selects for each row the throw that takes the fewest steps among those that hit.

    Args:
        steps: [B, ...], time steps of each throw; further dimensions distinguish the throws of a row.
        works: [B, ...] of bool, whether each throw hits.

    Returns:
        The indices [B] in each further dimension; 0 where no throw works.

    Example:
        >>> quickest(torch.tensor([[3.0, 1.0, 2.0]]), torch.tensor([[True, False, True]]))
        (tensor([2]),)
    """
    cost = torch.where(works, steps, torch.inf)
    return torch.unravel_index(cost.flatten(1).argmin(1), cost.shape[1:])
