"""The actor of SAC: bounds, and its greedy action."""

from __future__ import annotations

import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_her.modules import StochasticActorNet, make_stochastic_actor

from ..lost_game import SPEC, rows

# TD3 and SAC


@torch.no_grad()
def test_a_stochastic_actor_acts_within_its_bounds_and_greedily_by_its_location() -> None:
    torch.manual_seed(0)
    actor = make_stochastic_actor((4, 2), SPEC)
    seen = rows(256, action=torch.zeros(1, 256, 3))[0].select("observation", "desired_goal")
    with set_exploration_type(ExplorationType.RANDOM):
        one, other = actor(seen.clone())["action"], actor(seen.clone())["action"]
    assert not torch.equal(one, other)
    assert float(one.abs().max()) <= 2.0
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        acted = actor(seen.clone())
    torch.testing.assert_close(acted["action"], 2.0 * acted["loc"].tanh())


@torch.no_grad()
def test_scales_are_bounded() -> None:
    net = StochasticActorNet(2, 1)
    _, scale = net(torch.full((1, 2), 1e6))
    assert 0 < float(scale) <= 7.4  # exp(2)
