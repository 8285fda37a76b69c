"""DQN: targets by hand, and learning a known value."""

from __future__ import annotations

import pytest
import torch
from torchrl.objectives import SoftUpdate

from torchrl_her import LossLearner
from torchrl_her.modules import make_q_actor
from torchrl_her.objectives import Targets, make_dqn_loss

from ..lost_game import rows

TARGETS = Targets(gamma=0.5, reward_range=(-1.0, 0.0))


def test_dqn_targets_are_double_and_clamped() -> None:
    """By hand: the online network chooses action 1, whose value by the target network is -7."""
    actor, _ = make_q_actor((4, 2), 2)
    loss = make_dqn_loss(actor, targets=TARGETS)
    SoftUpdate(loss, tau=0.1)
    for params, values in (
        (loss.value_network_params, [0.0, 1.0]),
        (loss.target_value_network_params, [-1.0, -7.0]),
    ):
        for value in params.values(True, True):
            value.data.zero_()
        params["module", "0", "module", "layers", "3", "bias"].data.copy_(torch.tensor([[values]]))
    batch = rows(1, action=torch.zeros(1, 1, dtype=torch.int64))[0]
    loss(batch)
    # -1 + 0.5 * -7 = -4.5 is below -1 / (1 - 0.5) = -2, and the value of action 0 is 0
    assert float(batch["td_error"]) == pytest.approx(4.0)
    batch["steps_to_next_obs"] = torch.tensor([[4]])
    loss(batch)
    assert float(batch["td_error"]) == pytest.approx(1.4375**2)  # -1 - 7 / 2 ** 4


@pytest.mark.parametrize("runs", [1, 2])
def test_dqn_learns_the_value_of_a_lost_game(runs: int) -> None:
    torch.manual_seed(0)
    actor, _ = make_q_actor((4, 2), 3, runs=runs)
    loss = make_dqn_loss(actor, targets=TARGETS, reduction="none")
    learner = LossLearner(
        loss, torch.optim.Adam(loss.parameters(), lr=1e-2), SoftUpdate(loss, tau=0.1), runs=runs
    )
    for _ in range(200):
        batch = rows(32, action=torch.randint(3, (runs, 32)), runs=runs)
        measured = learner.update(batch if runs > 1 else batch[0].unsqueeze(0))
    assert measured["loss"].shape == (1, runs)
    seen = rows(64, action=torch.zeros(runs, 64, dtype=torch.int64), runs=runs)
    with torch.no_grad():
        value = actor(seen.select("observation", "desired_goal").reshape(-1))["chosen_action_value"]
    assert float(value.mean()) == pytest.approx(-2.0, abs=0.2)
