"""Scripted motions of the hand: going to a point, and throwing."""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_her_envs.throwing.effector import Effector
from torchrl_her_envs.throwing.experts.ballistics import LONGEST_FLIGHT, quickest, throw_velocity
from torchrl_her_envs.throwing.experts.clearance import clears_ceiling, clears_wall
from torchrl_her_envs.throwing.hand import Hand
from torchrl_her_envs.throwing.tasks import WorldConfig

_PLACES = (11, 10)  # columns and rows of places to throw from; many columns help with goals behind the wall


class HandSkill:
    """Skill of a controller for the hand. See :class:`~.controller.Skill`.

    Args:
        world: the constants of the world.
        wall: whether there is a wall to throw over.
    """

    def __init__(self, world: WorldConfig, *, wall: bool) -> None:
        self.effector: Effector = Hand(world, wall=wall)
        self._world, self._wall = world, wall

    def joints(self, state: Tensor) -> Tensor:
        return (state[:, :2] + 1.0) * (self._world.size / 2.0)

    def reach(self, joints: Tensor, target: Tensor) -> Tensor:
        return (target - joints) / self._world.time_step

    def throw(self, joints: Tensor, goal: Tensor, *, within: float) -> Tensor:
        """Returns the next velocity to carry a ball to where it can be thrown, or to throw it.

        In a throw, the hand moves to a place of a grid (or stays), swings for one step with the velocity of
        :func:`~.ballistics.throw_velocity`, and lets go. The quickest throw is taken. No plan is kept, since
        one step later the same throw is still possible, a step shorter.

        Returns:
            Velocities [B, 2] in meters a second; above the hand's speed if the place is several steps away.
            If no throw works, the velocity is meaningless.

        Example:
            >>> hand, goal = HandSkill(WorldConfig(), wall=False), torch.tensor([[4.0, 2.5]])
            >>> hand.throw(torch.tensor([[2.0, 3.0]]), goal, within=0.2)  # at once, flatly
            tensor([[ 7.1429, -0.8000]])
        """
        hand, world = self.effector, self._world
        places = torch.cat((joints.unsqueeze(1), _grid(hand, world).expand(len(joints), -1, -1)), 1)
        start, target = places[:, :, None, None], _aims(goal, world, within=within)[:, None, :, None]
        steps = torch.arange(1.0, LONGEST_FLIGHT + 1)
        velocity = throw_velocity(start, target, steps, world)  # [B, places, aims, steps, 2]
        works = _can_throw(start, velocity, hand, world, wall=self._wall)
        travel = _steps_to(places - joints.unsqueeze(1), hand.action_speed * world.time_step)
        place, aim, flight = quickest(travel[:, :, None, None] + steps, works)
        row = torch.arange(len(joints))
        arrived = travel[row, place].unsqueeze(-1) == 0
        go = (places[row, place] - joints) / world.time_step
        return torch.where(arrived, velocity[row, place, aim, flight], go)


def _grid(hand: Effector, world: WorldConfig) -> Tensor:
    """Returns places [places, 2] all over the box that the hand reaches."""
    left, bottom, right, top = (side * world.size for side in hand.reach)
    columns, rows = _PLACES
    return torch.cartesian_prod(torch.linspace(left, right, columns), torch.linspace(bottom, top, rows))


def _aims(goal: Tensor, world: WorldConfig, *, within: float) -> Tensor:
    """Returns points [B, 2, 2] to throw at: a goal's middle, and its far edge for goals behind the wall."""
    aims = goal.unsqueeze(1) + torch.tensor([[0.0, 0.0], [within, 0.0]])
    return aims.clamp(max=(1.0 - world.ball_radius) * world.size)


def _steps_to(gap: Tensor, stride: float) -> Tensor:
    """Returns the number of steps of a hand over a gap [..., 2], at most ``stride`` a step in x and in y."""
    return (gap.abs().amax(-1) / stride - 1e-3).ceil()  # a thousandth of a stride may be rounding


def _can_throw(start: Tensor, velocity: Tensor, hand: Effector, world: WorldConfig, *, wall: bool) -> Tensor:
    """Returns whether a swing stays within the hand's speed and reach, and the flight touches nothing."""
    launch = start + velocity * world.time_step
    x, y = launch.unbind(-1)
    left, bottom, right, top = (side * world.size for side in hand.reach)
    works = (velocity.abs() <= hand.action_speed).all(-1)
    works &= (x >= left) & (x <= right) & (y >= bottom) & (y <= top)
    works &= clears_ceiling(launch, velocity, world)
    return works & clears_wall(launch, velocity, world) if wall else works
