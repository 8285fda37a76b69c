"""Throws of an arm of two links."""

from __future__ import annotations

import math

import torch

from torchrl_her_envs import Arm, WorldConfig
from torchrl_her_envs.throwing.experts.arm import ArmSkill

WORLD = WorldConfig()


def test_an_arm_that_cannot_throw_gets_ready() -> None:
    hanging, goal = torch.tensor([[-math.pi / 2, 0.0]]), torch.tensor([[5.0, 4.9]])
    impossible = ArmSkill(WORLD).throw(hanging, goal, within=1e-6)
    ready = hanging + impossible * WORLD.time_step
    torch.testing.assert_close(ready.cos(), torch.tensor([[math.cos(math.radians(120)), 1.0]]))


def test_a_skill_reads_its_angles_and_reaches_in_one_step() -> None:
    skill = ArmSkill(WORLD)
    angles = torch.tensor([[0.5, -2.0]])
    torch.testing.assert_close(skill.joints(torch.cat((angles.cos(), angles.sin()), -1)), angles)
    arm = Arm(WORLD)
    near = arm.grip(torch.tensor([[0.6, -1.9]]))
    velocity = skill.reach(angles, near)
    torch.testing.assert_close(arm.grip(angles + velocity * WORLD.time_step), near, atol=1e-4, rtol=0)
