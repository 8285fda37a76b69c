"""TD3: learning a known value, and options that are refused."""

from __future__ import annotations

import pytest
import torch
from torchrl.objectives import SoftUpdate

from torchrl_her import LossLearner, make_actor, make_critic, make_td3_loss

from ..lost_game import SPEC, rows, say


def test_two_critics_learn_the_value_of_a_lost_game() -> None:
    torch.manual_seed(0)
    loss = make_td3_loss(make_actor((4, 2), 3), make_critic((4, 2), 3), action_spec=SPEC, gamma=0.5)
    learner = LossLearner(loss, torch.optim.Adam(loss.parameters(), lr=3e-3), SoftUpdate(loss, tau=0.1))
    for _ in range(150):
        batch = rows(64, action=torch.rand(1, 64, 3) * 4 - 2)[0]
        measured = learner.update(batch)
    assert float(measured["loss_qvalue"]) < 0.5
    assert batch["td_error"].shape == (64,)
    assert float(loss(batch)["pred_value"].mean()) == pytest.approx(-2.0, abs=0.3)


@pytest.mark.parametrize("gamma", [-0.1, 1.0])
def test_a_discount_out_of_range_is_named(gamma: float) -> None:
    with pytest.raises(ValueError, match=rf"gamma must be in \[0, 1\), got {gamma}"):
        make_td3_loss(make_actor((4, 2), 3), make_critic((4, 2), 3), action_spec=SPEC, gamma=gamma)


def test_rows_of_several_steps_discount_the_next_value_by_their_number() -> None:
    """By hand: critics that say 0 of everything, with targets that say -5 and -7."""
    critic = make_critic((4, 2), 3)
    for parameter in critic.parameters():
        parameter.data.zero_()
    loss = make_td3_loss(
        make_actor((4, 2), 3), critic, action_spec=SPEC, gamma=0.5, reward_range=(-10.0, 0.0)
    )
    SoftUpdate(loss, tau=0.1)
    say(loss, [0.0, 0.0], [-5.0, -7.0])
    batch = rows(3, action=torch.rand(1, 3, 3))[0]
    batch["steps_to_next_obs"] = torch.tensor([[1], [2], [3]])
    assert loss(batch)["target_value"].tolist() == [-4.5, -2.75, -1.875]  # -1 - 7 / 2, - 7 / 4, - 7 / 8
