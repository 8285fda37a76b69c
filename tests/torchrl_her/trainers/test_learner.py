"""Gradient steps by hand: clipping, importance weights, priorities; and that any TorchRL loss learns."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import Bounded, LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import PrioritizedSampler
from torchrl.modules import NormalParamExtractor, ProbabilisticActor, TanhNormal
from torchrl.objectives import DDPGLoss, LossModule, SACLoss, SoftUpdate, TD3Loss, ValueEstimators

from torchrl_her import FusedLearner, LossLearner, make_actor, make_critic, make_ddpg_loss
from torchrl_her.modules import NetworkShape

from ..ddpg_data import WEIGHT, batch, constant_loss, make_loss, rows, step, weights
from ..her_data import make_batch

# Most of these tests ask a loss for its numbers, and have no target networks to move.
pytestmark = pytest.mark.filterwarnings("ignore:No target network updater has been associated")


def same_loss(**options: Any) -> DDPGLoss:
    torch.manual_seed(5)
    return make_loss(**options)


def test_what_is_measured_is_the_mean_loss_of_each_run() -> None:
    data = rows([-1.0, -1.0], terminated=[1, 0])
    measured = step(constant_loss(-4.0, gamma=0.5), data)
    assert measured["loss_value"].tolist() == [[6.5]]
    assert measured["loss_actor"].tolist() == [[4.0]]
    assert not any(value.requires_grad for value in measured.values())


def test_actor_and_critic_are_clipped_apart() -> None:
    data = batch()
    huge = data.clone()
    huge["next", "reward"] *= 1e6
    changes = {}
    for name, own in (("small", data), ("huge", huge)):
        loss = same_loss(reward_range=(-1e9, 0.0))
        before = {part: weights(loss, part) for part in ("actor", "value")}
        step(loss, own, max_grad_norm=0.5)
        changes[name] = {part: weights(loss, part) - before[part] for part in before}
    assert changes["huge"]["value"].norm().item() == pytest.approx(0.5, rel=1e-3)
    assert 0 < changes["huge"]["actor"].norm() < 0.5  # small as it is, it is left alone
    assert torch.equal(changes["huge"]["actor"], changes["small"]["actor"])


def test_small_gradients_are_not_clipped() -> None:
    data, loss, other = batch(), same_loss(), same_loss()
    step(loss, data, max_grad_norm=1e6)
    out = other(data)
    (out["loss_actor"] + out["loss_value"]).backward()
    expected = weights(other) - torch.cat([p.grad.flatten() for p in other.parameters()])
    assert torch.allclose(weights(loss), expected, atol=1e-6)


# Importance weights


def test_importance_weights_are_used() -> None:
    data = rows([-1.0, -1.0], terminated=[1, 0])  # squared errors of 9 and 4
    data[WEIGHT] = torch.tensor([0.9, 0.3])
    assert step(constant_loss(-4.0, gamma=0.5), data)["loss_value"][0].tolist() == pytest.approx(
        [7.75]
    )  # 3 to 1


def test_a_prioritized_sampler_gives_its_weights_under_the_key_that_is_read() -> None:
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(64), sampler=PrioritizedSampler(64, 0.6, 0.4), batch_size=16
    )
    buffer.set_rng(torch.Generator().manual_seed(0))
    index = buffer.extend(batch(64))
    buffer.update_priority(index, torch.arange(1.0, 65.0))
    sample = buffer.sample()
    assert sample[WEIGHT].std() > 0
    loss, other = same_loss(), same_loss()
    with_weights, without = step(loss, sample.clone()), step(other, sample.exclude(WEIGHT))
    assert with_weights["loss_value"].item() != without["loss_value"].item()
    assert not torch.equal(weights(loss), weights(other))


# Other losses


def stochastic_actor() -> ProbabilisticActor:
    net = nn.Sequential(nn.Linear(6, 16), nn.ReLU(), nn.Linear(16, 6), NormalParamExtractor())

    class Joined(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.net = net

        def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
            return self.net(torch.cat(inputs, -1))

    module = TensorDictModule(Joined(), in_keys=["observation", "desired_goal"], out_keys=["loc", "scale"])
    return ProbabilisticActor(
        module, in_keys=["loc", "scale"], distribution_class=TanhNormal, return_log_prob=True
    )


def make_other(kind: str) -> LossModule:
    shape = NetworkShape(hidden=16)
    critic = make_critic((4, 2), 3, shape=shape)
    action = Bounded(-1.0, 1.0, shape=(3,))
    if kind == "td3":
        loss = TD3Loss(make_actor((4, 2), 3, shape=shape), critic, action_spec=action)
    else:
        loss = SACLoss(stochastic_actor(), critic, action_spec=action)
    loss.make_value_estimator(ValueEstimators.TD0, gamma=0.98)
    return loss


@pytest.mark.parametrize(
    ("kind", "losses"),
    [("td3", {"loss_actor", "loss_qvalue"}), ("sac", {"loss_actor", "loss_qvalue", "loss_alpha"})],
)
def test_other_losses_learn_as_well(kind: str, losses: set[str]) -> None:
    loss = make_other(kind)
    learner = LossLearner(loss, torch.optim.Adam(loss.parameters(), lr=1e-3), SoftUpdate(loss, tau=0.01))
    before = {name: p.detach().clone() for name, p in loss.named_parameters()}
    for _ in range(3):
        data = batch()
        data[WEIGHT] = torch.rand(32) + 0.5
        measured = learner.update(data)
        assert measured.keys() == losses
        assert all(value.shape == (1, 1) and value.isfinite().all() for value in measured.values())
        assert data["td_error"].shape == (32,)
    assert all(not torch.equal(before[name], p) for name, p in loss.named_parameters())


def test_each_network_is_clipped_by_itself_and_sacs_alpha_is_one() -> None:
    loss = make_other("sac")
    before = {part: weights(loss, part) for part in ("actor", "qvalue", "log_alpha")}
    step(loss, batch(), max_grad_norm=1e-3)
    for part, values in before.items():
        assert (weights(loss, part) - values).norm().item() == pytest.approx(1e-3, rel=0.02)


# Learning


def test_the_critic_learns_what_one_step_is_worth() -> None:
    data = batch(256)
    near = (data["action"][:, :1] > 0).float()
    data["next", "reward"], data["next", "terminated"] = near - 1.0, torch.ones(256, 1, dtype=torch.bool)
    loss = make_loss()
    learner = LossLearner(loss, torch.optim.Adam(loss.parameters(), lr=1e-2), SoftUpdate(loss, tau=0.05))
    measured = [learner.update(data)["loss_value"].item() for _ in range(150)]
    assert measured[0] > 0.3  # half of the rows are worth -1, and are thought to be worth about 0
    assert measured[-1] < 0.05
    with loss.actor_network_params.to_module(loss.actor_network):
        action = loss.actor_network(data.select("observation", "desired_goal"))["action"]
    assert (action[:, 0] > 0).float().mean() > 0.95


def test_priorities_go_where_the_loss_puts_them() -> None:
    loss = constant_loss(-4.0, gamma=0.5)
    loss.set_keys(priority="surprise")
    data = rows([-1.0, -1.0], terminated=[1, 0])
    LossLearner(loss, torch.optim.Adam(loss.parameters(), lr=0.1)).update(data)
    assert data["surprise"].tolist() == [9.0, 4.0]


@pytest.mark.parametrize("fused", [False, True])
@pytest.mark.parametrize("steps", [0, 3])
def test_rows_must_be_whole_batches(fused: bool, steps: int) -> None:
    loss = make_ddpg_loss(make_actor((2, 2), 1), make_critic((2, 2), 1))
    make = FusedLearner if fused else LossLearner
    learner = make(loss, torch.optim.Adam(loss.parameters()), SoftUpdate(loss, tau=0.1))
    with pytest.raises(ValueError, match=f"steps must be at least 1 and divide 10 rows, got {steps}"):
        learner.update(make_batch([[10]]), steps)
