"""TQC: targets by hand, TorchRL's numbers, learning a known value, and options that are refused."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.objectives import LossModule, SoftUpdate, TQCLoss

from torchrl_her import LossLearner, make_critic
from torchrl_her.modules import make_stochastic_actor
from torchrl_her.objectives import ActorTerms, critic_value, make_tqc_loss
from torchrl_her.objectives.tqc import PenalizedTQCLoss

from ..lost_game import SPEC, check_penalty, check_same_loss, rows, say, stochastic_loss, without_entropy


def make_loss(*, quantiles: int = 3, **options: Any) -> LossModule:
    return stochastic_loss(make_tqc_loss, outputs=quantiles, **options)


def test_targets_leave_out_the_greatest_quantiles_of_all_critics_together() -> None:
    loss = without_entropy(make_loss(dropped_quantiles=1))  # two of six
    say(loss, [[0.0] * 3] * 2, [[-8.0, -2.0, -6.0], [-1.0, -4.0, -10.0]])
    batch = rows(2, action=torch.rand(1, 2, 3))[0]
    batch["next", "terminated"][1] = True
    targets = loss.compute_target(batch).sort(-1).values
    assert targets[0].tolist() == [-6.0, -5.0, -4.0, -3.0]  # -1 + half of -10, -8, -6, -4
    assert targets[1].tolist() == [-1.0] * 4
    loss(batch)
    assert batch["td_error"].tolist() == pytest.approx([4.5, 1.0])  # mean distance from quantiles of 0


def test_the_quantile_loss_and_the_priority_by_hand() -> None:
    loss = without_entropy(make_loss(quantiles=2, critics=2, dropped_quantiles=0, gamma=0.0))
    say(loss, [[0.0, -1.5], [-1.0, -1.0]], [[0.0] * 2] * 2)
    batch = rows(1, action=torch.rand(1, 1, 3))[0]  # all targets are -1
    measured = loss(batch)
    # First critic: quantile 1/4 at 0 lies 1 above, (1 - 1/4) * 1/2; 3/4 at -1.5 lies 1/2 below, 3/4 * 1/8.
    assert measured["loss_qvalue"].item() == pytest.approx((0.375 + 0.09375) / 2)
    assert batch["td_error"].tolist() == pytest.approx([0.75])


def test_rows_of_several_steps_discount_the_next_value_by_their_number() -> None:
    loss = without_entropy(make_loss(quantiles=2, dropped_quantiles=1))
    say(loss, [[0.0, 0.0]] * 2, [[-5.0, 0.0], [-7.0, 9.0]])
    batch = rows(3, action=torch.rand(1, 3, 3))[0]
    batch["steps_to_next_obs"] = torch.tensor([[1], [2], [3]])
    targets = loss.compute_target(batch).sort(-1).values
    assert targets.tolist() == [[-4.5, -3.5], [-2.75, -2.25], [-1.875, -1.625]]


def test_targets_may_be_clamped_to_possible_returns() -> None:
    free, bounded = (
        without_entropy(make_loss(quantiles=2, dropped_quantiles=0, reward_range=own))
        for own in (None, (-1.0, 0.0))
    )
    batch = rows(1, action=torch.rand(1, 1, 3))[0]
    for loss in (free, bounded):
        say(loss, [[0.0, 0.0]] * 2, [[-9.0, 9.0]] * 2)
    assert free.compute_target(batch).tolist() == [[-5.5, -5.5, 3.5, 3.5]]
    assert bounded.compute_target(batch).tolist() == [[-2.0, -2.0, 0.0, 0.0]]


def own_and_torchrls(**options: Any) -> tuple[LossModule, TQCLoss]:
    """Our loss, and TorchRL's with the same weights."""
    ours = make_loss(quantiles=5, **options)
    plain = TQCLoss(
        make_stochastic_actor((4, 2), SPEC),
        make_critic((4, 2), 3, outputs=5),
        action_spec=SPEC,
        num_qvalue_nets=2,
        top_quantiles_to_drop_per_net=2,
    )
    plain.make_value_estimator(gamma=0.5)
    plain.load_state_dict(ours.state_dict())
    SoftUpdate(plain, tau=0.1)
    return ours, plain


def test_without_a_penalty_it_is_torchrls_loss() -> None:
    batch = rows(16, action=torch.rand(1, 16, 3))[0]
    batch["next", "terminated"][::3] = True
    batch["priority_weight"] = torch.rand(16) + 0.1
    check_same_loss(*own_and_torchrls(), batch)


def test_the_penalty_is_the_mean_square_of_the_drawn_actions() -> None:
    check_penalty(*own_and_torchrls(terms=ActorTerms(action_penalty=0.7)), penalty=0.7)


@pytest.mark.parametrize("runs", [1, 2])
def test_it_learns_the_value_of_a_lost_game(runs: int) -> None:
    torch.manual_seed(0)
    loss = make_loss(quantiles=5, runs=runs, reduction="none", temperature=1e-3)
    learner = LossLearner(
        loss, torch.optim.Adam(loss.parameters(), lr=3e-3), SoftUpdate(loss, tau=0.1), runs=runs
    )
    for _ in range(200):
        batch = rows(64, action=torch.rand(runs, 64, 3) * 4 - 2, runs=runs)
        measured = learner.update(batch)
    assert measured["loss_qvalue"].shape == (1, runs)
    value = critic_value(loss, batch)
    assert value is not None
    assert value.shape == (runs, 64, 1)
    assert value.mean((1, 2)).tolist() == pytest.approx([-2.0] * runs, abs=0.3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"gamma": 1.0}, r"gamma must be in \[0, 1\), got 1.0"),
        ({"temperature": 0.0}, "temperature must be positive, got 0.0"),
        ({"critics": 0}, "critics must be at least 1, got 0"),
        ({"dropped_quantiles": 3}, "must be from 0 to 2, since critics have 3 quantiles, got 3"),
        ({"dropped_quantiles": -1}, "must be from 0 to 2, since critics have 3 quantiles, got -1"),
    ],
)
def test_what_cannot_be_is_named(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_loss(**options)


def test_targets_of_some_critics_are_refused() -> None:
    actor = make_stochastic_actor((4, 2), SPEC)
    critic = make_critic((4, 2), 3, outputs=3)
    with pytest.raises(TypeError, match=r"TQC's targets use the quantiles of all critics.* target_critics=1"):
        PenalizedTQCLoss(actor, critic, action_spec=SPEC, num_qvalue_nets=2, target_critics=1)


class OwnCritic(nn.Module):
    def forward(self, observation: Tensor, desired_goal: Tensor, action: Tensor) -> Tensor:
        return torch.cat((observation, desired_goal, action), -1)[..., :5]


def test_critics_without_quantiles_are_told_how_to_get_them() -> None:
    actor = make_stochastic_actor((4, 2), SPEC)
    keys = ["observation", "desired_goal", "action"]
    own = TensorDictModule(OwnCritic(), in_keys=keys, out_keys=["state_action_value"])
    with pytest.raises(ValueError, match=r"from make_critic\(\.\.\., outputs=M\) .* got OwnCritic"):
        make_tqc_loss(actor, own)
    one = make_critic((4, 2), 3)
    with pytest.raises(ValueError, match=r"critics have 1 quantile, .*make_critic\(\.\.\., outputs=M\)"):
        make_tqc_loss(actor, one)
