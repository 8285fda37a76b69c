"""SAC: learning a known value, and options that are refused."""

from __future__ import annotations

import pytest
import torch
from torchrl.objectives import SoftUpdate

from torchrl_her import LossLearner, make_critic, make_sac_loss, make_stochastic_actor

from ..lost_game import SPEC, rows, say


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


def test_rows_of_several_steps_discount_the_next_value_by_their_number() -> None:
    """By hand: critics that say 0, with targets of -5 and -7, and a temperature so low that it is nothing."""
    loss = make_sac_loss(
        make_stochastic_actor((4, 2), SPEC), make_critic((4, 2), 3), action_spec=SPEC, gamma=0.5
    )
    SoftUpdate(loss, tau=0.1)
    loss.log_alpha.data.fill_(-50.0)
    say(loss, [0.0, 0.0], [-5.0, -7.0])
    batch = rows(3, action=torch.rand(1, 3, 3))[0]
    batch["steps_to_next_obs"] = torch.tensor([[1], [2], [3]])
    loss(batch)
    # -1 - 7 / 2, -1 - 7 / 4, -1 - 7 / 8, as distances from 0
    assert batch["td_error"].tolist() == pytest.approx([4.5, 2.75, 1.875])
