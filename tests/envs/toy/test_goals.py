"""Goals on a lattice, and in the toy environments."""

from __future__ import annotations

import pytest
import torch

from torchrl_her_envs import LatticeGoals

from .toy_envs import Make, every_env


def test_lattices() -> None:
    goals = LatticeGoals([0.0, -1.0], [2.0, 1.0], count=3)
    assert goals.from_uniform(torch.tensor([[0.0, 0.99], [0.34, 0.6]])).tolist() == [[0.0, 1.0], [1.0, 0.0]]
    nearly_one = torch.full((1, 1), 1 - 2**-24, dtype=torch.float32)
    assert LatticeGoals([0.0], [100.0], count=101).from_uniform(nearly_one).item() == 100.0
    half = goals.scaled(0.5, 3.0)
    assert (half.low.tolist(), half.high.tolist()) == ([3.0, 2.5], [4.0, 3.5])
    assert not goals.is_box
    with pytest.raises(ValueError, match=r"low <= high, got low=\[1.0\], high=\[0.0\]"):
        LatticeGoals([1.0], [0.0], count=2)
    with pytest.raises(ValueError, match=r"count must be at least 2 from low=\[0.0\] .* got 1"):
        LatticeGoals([0.0], [1.0], count=1)
    with pytest.raises(ValueError, match="count must be at least 1 .* got 0"):
        LatticeGoals([1.0], [1.0], count=0)


@every_env
def test_goals_that_are_sampled_are_goals_that_occur(make: Make) -> None:
    env = make(num_envs=3000)
    occur = env.reset()["desired_goal"].unique(dim=0)
    sampled = env.goal_distribution.sample(3000, generator=torch.Generator().manual_seed(0)).float()
    assert torch.equal(sampled.unique(dim=0), occur)  # at most 32 of them: none is missed
    assert (occur >= env.goal_distribution.low).all()
    assert (occur <= env.goal_distribution.high).all()
