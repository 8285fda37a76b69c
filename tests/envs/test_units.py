"""Tasks in other units."""

from __future__ import annotations

import pytest
import torch

from torchrl_her_envs import make_env
from torchrl_her_envs.units import in_units


@pytest.mark.parametrize("task", ["hand_v1", "gym:torchrl_her_envs:torchrl_her/HandReach-v0"])
@pytest.mark.parametrize("factor", [1_000.0, 0.001])
def test_only_the_unit_differs(task: str, factor: float) -> None:
    torch.manual_seed(0)
    own, other = make_env(task, num_envs=3, seed=5), in_units(task, factor, num_envs=3, seed=5)
    action = own.fake_tensordict().expand(60, 3)["action"].clone().uniform_(-1, 1)
    one, two = own.reset(), other.reset()
    for step in action:
        one, two = own.step(one.set("action", step))["next"], other.step(two.set("action", step))["next"]
        for key in ("observation", "achieved_goal", "desired_goal"):
            torch.testing.assert_close(two[key], one[key] * factor)
        assert torch.equal(two["reward"], one["reward"])
        goals = two["achieved_goal"], two["desired_goal"]
        assert torch.equal(other.compute_reward(*goals), two["reward"])
        assert torch.equal(other.compute_terminated(*goals), two["terminated"])
        if one["done"].any():
            one, two = own.reset(one.set("_reset", one["done"])), other.reset(two.set("_reset", two["done"]))
