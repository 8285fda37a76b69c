"""The values of discrete actions, and acting greedily by them."""

from __future__ import annotations

import torch

from torchrl_her.modules import QNet, make_q_actor

from ..lost_game import rows

# DQN


def test_the_greedy_action_has_the_greatest_value() -> None:
    actor, critic = make_q_actor((4, 2), 5)
    seen = rows(8, action=torch.zeros(1, 8, dtype=torch.int64))[0]
    values = actor.module[0].module(seen["observation"], seen["desired_goal"])
    acted = actor(seen.select("observation", "desired_goal"))
    assert torch.equal(acted["action"], values.argmax(-1))
    assert torch.equal(critic(acted)["state_action_value"].squeeze(-1), values.amax(-1))


def test_runs_of_a_q_network_are_apart() -> None:
    pair = QNet(6, 5, runs=2)
    x = torch.randn(8, 6)
    before = pair(x)
    with torch.no_grad():
        for parameter in pair.parameters():
            parameter[1] += 1.0
    after = pair(x)
    assert torch.equal(before[:4], after[:4])
    assert not torch.equal(before[4:], after[4:])
