"""DDPG with the action L2 penalty, against TorchRL's own loss."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.objectives import DDPGLoss, ValueEstimators

from torchrl_her import make_actor, make_critic, make_ddpg_loss
from torchrl_her.objectives import ActorTerms, PenalizedDDPGLoss

from ..ddpg_data import batch, networks
from ..her_data import make_batch

# Most of these tests ask a loss for its numbers, and have no target networks to move.
pytestmark = pytest.mark.filterwarnings("ignore:No target network updater has been associated")


def plain_loss(actor: TensorDictModule, critic: TensorDictModule) -> DDPGLoss:
    loss = DDPGLoss(actor, critic, delay_actor=True, delay_value=True)
    loss.make_value_estimator(ValueEstimators.TD0, gamma=0.9)
    return loss


def penalized_loss(
    actor: TensorDictModule, critic: TensorDictModule, penalty: float, **options: Any
) -> DDPGLoss:
    loss = PenalizedDDPGLoss(
        actor, critic, delay_actor=True, delay_value=True, terms=ActorTerms(action_penalty=penalty), **options
    )
    loss.make_value_estimator(ValueEstimators.TD0, gamma=0.9)
    return loss


def test_without_a_penalty_it_is_torchrls_loss() -> None:
    nets, data = networks(), batch()
    plain, penalized = plain_loss(*nets)(data), penalized_loss(*nets, 0.0)(data)
    assert torch.equal(plain["loss_actor"], penalized["loss_actor"])
    assert torch.equal(plain["loss_value"], penalized["loss_value"])


def test_the_penalty_is_the_mean_square_of_the_actions() -> None:
    nets, data = networks(), batch()
    plain, penalized = plain_loss(*nets)(data), penalized_loss(*nets, 0.7)(data)
    action = nets[0](data.select("observation", "desired_goal"))["action"]
    assert action.square().mean() > 0.1
    price = 0.7 * action.square().sum().item() / (32 * 3)
    assert (penalized["loss_actor"] - plain["loss_actor"]).item() == pytest.approx(price, rel=1e-5)
    assert torch.equal(plain["loss_value"], penalized["loss_value"])


def test_the_penalty_may_be_kept_apart_for_each_transition() -> None:
    nets, data = networks(), batch(4)
    free = penalized_loss(*nets, 0.0, reduction="none")(data)["loss_actor"]
    priced = penalized_loss(*nets, 3.0, reduction="none")(data)["loss_actor"]
    action = nets[0](data.select("observation", "desired_goal"))["action"]
    assert (priced - free).tolist() == pytest.approx(action.square().sum(-1).tolist(), rel=1e-4)


def test_the_penalty_reaches_the_actor_only() -> None:
    nets, data = networks(), batch()
    losses = [penalized_loss(*deepcopy(nets), penalty) for penalty in (0.0, 5.0)]
    for loss in losses:
        loss(data)["loss_actor"].backward()
    free, priced = ({name: p.grad for name, p in loss.named_parameters()} for loss in losses)
    for name in free:
        if name.startswith("value_network"):
            assert free[name] is None
            assert priced[name] is None
        else:
            assert not torch.allclose(free[name], priced[name])


def test_a_critic_may_write_its_value_elsewhere() -> None:
    losses = []
    for key in ("state_action_value", "q"):
        torch.manual_seed(0)
        loss = make_ddpg_loss(make_actor((2, 2), 1), make_critic((2, 2), 1, value_key=key))
        losses.append(loss(make_batch([[6]]).squeeze(0))["loss_value"])
    assert torch.equal(*losses)
