"""Throws of a hand."""

from __future__ import annotations

import torch

from torchrl_her_envs import WorldConfig
from torchrl_her_envs.throwing.experts.ballistics import fly
from torchrl_her_envs.throwing.experts.hand import HandSkill

WORLD = WorldConfig()


def test_a_throw_that_can_be_made_from_here_is_made_at_once() -> None:
    grip, goal = torch.tensor([[2.0, 3.0]]), torch.tensor([[4.0, 2.5]])
    velocity = HandSkill(WORLD, wall=False).throw(grip, goal, within=0.2)
    assert velocity.abs().max() <= WORLD.hand_speed
    launch = grip + velocity * WORLD.time_step
    substeps = torch.arange(1.0, 31.0) * WORLD.substeps
    points = fly(launch.unsqueeze(1), velocity.unsqueeze(1), substeps, WORLD)
    assert (points - goal).norm(dim=-1).min() < 0.2


def test_a_hand_behind_the_wall_first_goes_to_a_better_place() -> None:
    low, goal = torch.tensor([[2.7, 0.3]]), torch.tensor([[3.5, 1.0]])
    over, free = (HandSkill(WORLD, wall=wall).throw(low, goal, within=0.2) for wall in (True, False))
    assert over[0, 1] > 0  # upwards, over the top
    assert not torch.allclose(over, free)


def test_a_skill_reads_its_place_and_reaches_in_one_step() -> None:
    skill = HandSkill(WORLD, wall=False)
    at = skill.joints(torch.tensor([[0.0, -0.5, 9.0, 9.0, 1.0]]))
    assert at.tolist() == [[3.0, 1.5]]
    velocity = skill.reach(at, torch.tensor([[3.2, 1.4]]))
    torch.testing.assert_close(at + velocity * WORLD.time_step, torch.tensor([[3.2, 1.4]]))
