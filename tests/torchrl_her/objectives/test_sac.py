"""SAC: learning a known value, and options that are refused."""

from __future__ import annotations

import pytest
import torch
from torchrl.objectives import SoftUpdate

from torchrl_her import LossLearner, make_critic, make_sac_loss, make_stochastic_actor

from ..lost_game import SPEC, rows


def test_two_critics_learn_the_value_of_a_lost_game() -> None:
    torch.manual_seed(0)
    critic = make_critic((4, 2), 3)
    loss = make_sac_loss(make_stochastic_actor((4, 2), SPEC), critic, action_spec=SPEC, gamma=0.5)
    learner = LossLearner(loss, torch.optim.Adam(loss.parameters(), lr=3e-3), SoftUpdate(loss, tau=0.1))
    for _ in range(150):
        batch = rows(64, action=torch.rand(1, 64, 3) * 4 - 2)[0]
        measured = learner.update(batch)
    assert float(measured["loss_qvalue"]) < 0.5
    assert batch["td_error"].shape == (64,)


@pytest.mark.parametrize("gamma", [-0.1, 1.0])
def test_a_discount_out_of_range_is_named(gamma: float) -> None:
    actor, critic = make_stochastic_actor((4, 2), SPEC), make_critic((4, 2), 3)
    with pytest.raises(ValueError, match=rf"gamma must be in \[0, 1\), got {gamma}"):
        make_sac_loss(actor, critic, action_spec=SPEC, gamma=gamma)
