"""Scripted motions of the arm: turning to a point, and throwing."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchrl_her_envs.throwing.arm import Arm
from torchrl_her_envs.throwing.effector import Effector
from torchrl_her_envs.throwing.experts.ballistics import LONGEST_FLIGHT, fly, quickest
from torchrl_her_envs.throwing.experts.clearance import clears_ceiling, is_free
from torchrl_her_envs.throwing.experts.inverse_kinematics import nearest_turn, turn
from torchrl_her_envs.throwing.tasks import WorldConfig

_SPEEDS = 9  # number of speeds of each joint, from full speed one way to full speed the other way
_LONGEST_SWING = 16  # number of steps of the longest swing, in which a joint turns by up to 147 degrees
_READY = (math.radians(120.0), 0.0)  # joint angles, up and back: throws from around here reach all goals


class ArmSkill:
    """Skill of a controller for an arm of two links. See :class:`~.controller.Skill`.

    Args:
        world: the constants of the world.
        num_links: number of links of the arm.

    Raises:
        ValueError: the arm does not have two links.
    """

    def __init__(self, world: WorldConfig, *, num_links: int = 2) -> None:
        if num_links != 2:
            raise ValueError(f"a controller can only solve an arm of 2 links, got num_links={num_links}")
        self.effector: Effector = Arm(world, num_links=num_links)
        self._world = world
        self._base = torch.tensor(world.arm_base) * world.size

    def joints(self, state: Tensor) -> Tensor:
        return torch.atan2(state[:, 2:4], state[:, 0:2])

    def reach(self, joints: Tensor, target: Tensor) -> Tensor:
        return nearest_turn(joints, target, self._base, self._world.arm_length) / self._world.time_step

    def throw(self, joints: Tensor, goal: Tensor, *, within: float) -> Tensor:
        """Returns the next velocity of the joints to throw a ball at the goal, or to get ready for a throw.

        In a throw, each joint turns at a constant speed from a grid for some steps; then the ball is let go.
        The quickest throw is taken; if none works from here, the arm turns to where it can throw at all
        goals. No plan is kept, since one step later the same throw is still possible, a step shorter.

        Returns:
            Velocities [B, 2] in radians a second; above the arm's speed if a turn takes several steps.

        Example:
            >>> arm, goal = ArmSkill(WorldConfig()), torch.tensor([[5.0, 4.0]])
            >>> arm.throw(torch.tensor([[1.6, 0.0]]), goal, within=0.2)  # over the top, clockwise
            tensor([[-4., -3.]])
        """
        world = self._world
        speeds, launch, velocity = _swings(joints, self.effector, world)
        flight = _steps_to_column(goal[:, None, None, 0] - launch[..., 0], velocity[..., 0], world)
        points = fly(launch.unsqueeze(-2), velocity.unsqueeze(-2), flight * world.substeps, world)
        hits = (points - goal[:, None, None, None]).square().sum(-1) < within**2  # [B, speeds, steps, 2]
        clear = is_free(launch, world, wall=False) & clears_ceiling(launch, velocity, world)
        works = hits & is_free(points, world, wall=False) & clear.unsqueeze(-1)
        swing, *_ = quickest(torch.arange(1.0, _LONGEST_SWING + 1).unsqueeze(-1) + flight, works)
        ready = turn(joints, torch.tensor(_READY)) / world.time_step
        return torch.where(works.flatten(1).any(1, keepdim=True), speeds[swing], ready)


def _swings(joints: Tensor, arm: Effector, world: WorldConfig) -> tuple[Tensor, Tensor, Tensor]:
    """Returns constant speeds of the joints [speeds, 2], and the ball's positions after 1, 2, ... steps.

    The ball's positions and velocities are [B, speeds, steps, 2] each.
    """
    line = torch.linspace(-arm.action_speed, arm.action_speed, _SPEEDS)
    speeds = torch.cartesian_prod(*[line] * arm.num_joints)
    time = torch.arange(_LONGEST_SWING + 1) * world.time_step
    path = arm.grip(joints[:, None, None] + speeds[:, None] * time[:, None])
    return speeds, path[:, :, 1:], path.diff(dim=2) / world.time_step


def _steps_to_column(gap: Tensor, speed: Tensor, world: WorldConfig) -> Tensor:
    """Returns the numbers of steps [..., 2], rounded down and up, in which a ball crosses a gap in x."""
    steps = (
        gap / (speed.clamp(min=1e-3) * world.time_step)
    ).floor()  # a ball that moves left never crosses the gap
    return torch.stack((steps, steps + 1), -1).clamp(1, LONGEST_FLIGHT)
