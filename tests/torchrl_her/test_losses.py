"""Targets, penalties, clipping and target networks by hand; and that other TorchRL losses work as well."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import Bounded, LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import PrioritizedSampler
from torchrl.modules import NormalParamExtractor, ProbabilisticActor, TanhNormal
from torchrl.objectives import DDPGLoss, HardUpdate, LossModule, SACLoss, SoftUpdate, TD3Loss, ValueEstimators

from torchrl_her import (
    FusedDDPGLearner,
    LossLearner,
    PenalisedDDPGLoss,
    clip_by_run,
    make_actor,
    make_critic,
    make_ddpg_loss,
    make_target_updater,
    stack_runs,
    take_run,
)

from .her_data import make_batch

WEIGHT = "priority_weight"

# Most of these tests ask a loss for its numbers, and have no target networks to move.
pytestmark = pytest.mark.filterwarnings("ignore:No target network updater has been associated")


def rows(
    reward: list[float], *, terminated: list[int] | None = None, done: list[int] | None = None
) -> TensorDict:
    """Rows with random inputs; ``done`` is truncated or terminated, and what is terminated if not given."""
    n = len(reward)
    ends = torch.tensor(terminated or [0] * n).bool().unsqueeze(-1)

    def seen() -> dict[str, Tensor]:
        return {"observation": torch.randn(n, 4), "desired_goal": torch.randn(n, 2)}

    after = {
        **seen(),
        "reward": torch.tensor(reward).unsqueeze(-1),
        "terminated": ends,
        "done": ends if done is None else torch.tensor(done).bool().unsqueeze(-1),
    }
    return TensorDict({**seen(), "action": torch.rand(n, 3) * 2 - 1, "next": after}, batch_size=[n])


def batch(n: int = 32) -> TensorDict:
    return rows([-1.0] * n)


class ConstantValue(nn.Module):
    """A critic that thinks the same of everything."""

    def __init__(self, value: float) -> None:
        super().__init__()
        self.value = nn.Parameter(torch.tensor(value))

    def forward(self, *inputs: Tensor) -> Tensor:
        return self.value.expand(*inputs[0].shape[:-1], 1)


def constant_loss(value: float, **options: Any) -> DDPGLoss:
    critic = TensorDictModule(
        ConstantValue(value),
        in_keys=["observation", "desired_goal", "action"],
        out_keys=["state_action_value"],
    )
    return make_ddpg_loss(make_actor((4, 2), 3), critic, **options)


def make_loss(**options: Any) -> DDPGLoss:
    return make_ddpg_loss(make_actor((4, 2), 3, hidden=16), make_critic((4, 2), 3, hidden=16), **options)


def weights(loss: LossModule, network: str = "") -> Tensor:
    """A copy of all trained numbers of a loss, or of one of its networks."""
    own = [p.detach().flatten() for name, p in loss.named_parameters() if name.startswith(network)]
    return torch.cat(own).clone()


def numbers(loss: LossModule, parameters: str) -> Tensor:
    """A copy of all numbers of one set of parameters, trained or not."""
    return torch.cat([p.detach().flatten() for p in getattr(loss, parameters).values(True, True)]).clone()


# Targets


def test_truncated_rows_bootstrap_and_terminated_ones_do_not() -> None:
    data = rows([-1.0, -1.0, -1.0, 0.0], terminated=[0, 0, 1, 1], done=[0, 1, 1, 1])
    target = constant_loss(-5.0, gamma=0.5, reward_range=(-10.0, 0.0))(data)["target_value"]
    assert target.tolist() == [-3.5, -3.5, -1.0, 0.0]  # -1 - 0.5 * 5 where the episode may go on


@pytest.mark.parametrize(("gamma", "expected"), [(0.98, -1.0 - 0.98 * 10), (0.5, -6.0), (0.0, -1.0)])
def test_gamma_is_the_one_that_was_given(gamma: float, expected: float) -> None:
    loss = constant_loss(-10.0, gamma=gamma, reward_range=(-100.0, 0.0))
    assert loss(rows([-1.0]))["target_value"].item() == pytest.approx(expected)


def test_gamma_is_098_by_default() -> None:
    assert constant_loss(-10.0)(rows([-1.0]))["target_value"].item() == pytest.approx(-10.8)


def test_targets_are_clamped_to_what_is_possible() -> None:
    assert constant_loss(-200.0)(rows([-1.0]))["target_value"].item() == pytest.approx(-50.0)
    assert constant_loss(100.0)(rows([-1.0]))["target_value"].item() == 0.0
    assert constant_loss(-49.0)(rows([-1.0]))["target_value"].item() == pytest.approx(-49.02)


@pytest.mark.parametrize(
    ("reward_range", "low", "high"),
    [((-1.0, 0.0), -2.0, 0.0), ((0.0, 1.0), 0.0, 2.0), ((-2.0, 3.0), -4.0, 6.0), ((1.0, 2.0), 1.0, 4.0)],
)
def test_bounds_of_targets(reward_range: tuple[float, float], low: float, high: float) -> None:
    for value, expected in ((-1000.0, low), (1000.0, high)):
        loss = constant_loss(value, gamma=0.5, reward_range=reward_range)
        assert loss(rows([0.0]))["target_value"].item() == expected


@pytest.mark.parametrize("gamma", [1.0, -0.1])
def test_a_discount_out_of_range_is_named(gamma: float) -> None:
    with pytest.raises(ValueError, match=rf"gamma must be in \[0, 1\), got {gamma}"):
        make_loss(gamma=gamma)


def test_the_priority_is_the_square_of_the_error() -> None:
    # Priorities get half of Schaul's alpha because of this: should TorchRL change it, so must that.
    data = rows([-1.0, -1.0], terminated=[1, 0])
    out = constant_loss(-4.0, gamma=0.5)(data)
    assert data["td_error"].tolist() == [9.0, 4.0]  # -4 against -1, and against -2: -1 - 0.5 * 4, clamped
    assert out["loss_value"].item() == 6.5


# The price of large actions


def plain_loss(actor: TensorDictModule, critic: TensorDictModule) -> DDPGLoss:
    loss = DDPGLoss(actor, critic, delay_actor=True, delay_value=True)
    loss.make_value_estimator(ValueEstimators.TD0, gamma=0.9)
    return loss


def penalised_loss(
    actor: TensorDictModule, critic: TensorDictModule, penalty: float, **options: Any
) -> DDPGLoss:
    loss = PenalisedDDPGLoss(
        actor, critic, delay_actor=True, delay_value=True, action_penalty=penalty, **options
    )
    loss.make_value_estimator(ValueEstimators.TD0, gamma=0.9)
    return loss


def networks() -> tuple[TensorDictModule, TensorDictModule]:
    actor, critic = make_actor((4, 2), 3, hidden=16), make_critic((4, 2), 3, hidden=16)
    with torch.no_grad():
        actor.module.layers[3].weight.normal_()  # actions all over the range
    return actor, critic


def test_without_a_price_it_is_torchrls_loss() -> None:
    nets, data = networks(), batch()
    plain, penalised = plain_loss(*nets)(data), penalised_loss(*nets, 0.0)(data)
    assert torch.equal(plain["loss_actor"], penalised["loss_actor"])
    assert torch.equal(plain["loss_value"], penalised["loss_value"])


def test_the_price_is_the_mean_square_of_the_actions() -> None:
    nets, data = networks(), batch()
    plain, penalised = plain_loss(*nets)(data), penalised_loss(*nets, 0.7)(data)
    action = nets[0](data.select("observation", "desired_goal"))["action"]
    assert action.square().mean() > 0.1
    price = 0.7 * action.square().sum().item() / (32 * 3)
    assert (penalised["loss_actor"] - plain["loss_actor"]).item() == pytest.approx(price, rel=1e-5)
    assert torch.equal(plain["loss_value"], penalised["loss_value"])


def test_the_price_may_be_kept_apart_for_each_row() -> None:
    nets, data = networks(), batch(4)
    free = penalised_loss(*nets, 0.0, reduction="none")(data)["loss_actor"]
    priced = penalised_loss(*nets, 3.0, reduction="none")(data)["loss_actor"]
    action = nets[0](data.select("observation", "desired_goal"))["action"]
    assert (priced - free).tolist() == pytest.approx(action.square().sum(-1).tolist(), rel=1e-4)


def test_the_price_reaches_the_actor_only() -> None:
    nets, data = networks(), batch()
    losses = [penalised_loss(*deepcopy(nets), penalty) for penalty in (0.0, 5.0)]
    for loss in losses:
        loss(data)["loss_actor"].backward()
    free, priced = ({name: p.grad for name, p in loss.named_parameters()} for loss in losses)
    for name in free:
        if name.startswith("value_network"):
            assert free[name] is None
            assert priced[name] is None
        else:
            assert not torch.allclose(free[name], priced[name])


# Gradient steps


def step(loss: LossModule, data: TensorDict, **options: Any) -> dict[str, Tensor]:
    """One step of plain gradient descent with rate 1: weights change by minus the clipped gradient."""
    return LossLearner(loss, torch.optim.SGD(loss.parameters(), lr=1.0), **options).update(data)


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


def test_clipping_by_run_is_clipping_each_run() -> None:
    gradients = [torch.randn(2, 3, 4), torch.randn(2, 1, 4)]
    gradients[0][0] *= 100.0
    gradients[0][1], gradients[1][1] = gradients[0][1] * 0.01, gradients[1][1] * 0.01
    stacked = [nn.Parameter(torch.zeros_like(gradient)) for gradient in gradients]
    for parameter, gradient in zip(stacked, gradients, strict=True):
        parameter.grad = gradient.clone()
    norms = clip_by_run(stacked, 3.0, runs=2)
    for run in range(2):
        single = [nn.Parameter(torch.zeros_like(gradient[run])) for gradient in gradients]
        for parameter, gradient in zip(single, gradients, strict=True):
            parameter.grad = gradient[run].clone()
        assert norms[run].item() == pytest.approx(nn.utils.clip_grad_norm_(single, 3.0).item(), rel=1e-5)
        for parameter, one in zip(stacked, single, strict=True):
            assert torch.allclose(parameter.grad[run], one.grad, rtol=1e-5)
    assert torch.equal(stacked[0].grad[1], gradients[0][1])  # short enough: not touched


@pytest.mark.parametrize("network", ["actor", "value"])
def test_targets_move_softly(network: str) -> None:
    loss = make_loss()
    learner = LossLearner(
        loss, torch.optim.SGD(loss.parameters(), lr=1.0), make_target_updater(loss, tau=0.25, hard_interval=0)
    )
    online, target = f"{network}_network_params", f"target_{network}_network_params"
    before = numbers(loss, target)
    learner.update(batch())
    moved = 0.75 * before + 0.25 * numbers(loss, online)
    assert not torch.allclose(numbers(loss, online), before, atol=1e-4)
    assert torch.allclose(numbers(loss, target), moved, atol=1e-6)


@pytest.mark.parametrize("interval", [1, 3])
def test_targets_are_copied_every_so_many_steps(interval: int) -> None:
    loss = make_loss()
    learner = LossLearner(
        loss,
        torch.optim.SGD(loss.parameters(), lr=0.1),
        make_target_updater(loss, tau=0.01, hard_interval=interval),
    )
    copied = []
    for _ in range(2 * interval):
        learner.update(batch())
        copied.append(torch.equal(numbers(loss, "target_value_network_params"), weights(loss, "value")))
    assert copied == ([False] * (interval - 1) + [True]) * 2


def test_kinds_of_target_updates() -> None:
    assert type(make_target_updater(make_loss(), tau=0.1, hard_interval=0)) is SoftUpdate
    assert type(make_target_updater(make_loss(), tau=0.1, hard_interval=5)) is HardUpdate


# Importance weights


def test_importance_weights_are_used() -> None:
    data = rows([-1.0, -1.0], terminated=[1, 0])  # squared errors of 9 and 4
    data[WEIGHT] = torch.tensor([0.9, 0.3])
    assert step(constant_loss(-4.0, gamma=0.5), data)["loss_value"][0].tolist() == pytest.approx(
        [7.75]
    )  # 3 to 1


def test_a_prioritised_sampler_gives_its_weights_under_the_key_that_is_read() -> None:
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


# Runs side by side


@pytest.mark.parametrize("weighted", [False, True])
def test_runs_learn_together_what_they_learn_alone(weighted: bool) -> None:
    data = [batch(16) for _ in range(2)]
    if weighted:
        for own in data:
            own[WEIGHT] = torch.rand(16) + 0.1
    nets = [networks() for _ in range(2)]
    pair = make_actor((4, 2), 3, hidden=16, runs=2), make_critic((4, 2), 3, hidden=16, runs=2)
    for net, states in zip(pair, zip(*nets, strict=True), strict=True):
        net.load_state_dict(stack_runs([state.state_dict() for state in states]))
    options = {"max_grad_norm": 0.01}  # short enough to clip all of them
    together = make_ddpg_loss(*pair, action_penalty=0.5, reduction="none")
    measured = step(together, torch.cat(data), runs=2, **options)
    for run, (own, rows_of_run) in enumerate(zip(nets, data, strict=True)):
        alone = make_ddpg_loss(*own, action_penalty=0.5)
        single = step(alone, rows_of_run, **options)
        for key, value in single.items():
            assert measured[key][0, run].item() == pytest.approx(value.item(), rel=1e-4)
        for part in ("actor_network_params", "value_network_params"):
            expected = dict(getattr(alone, part).flatten_keys("."))
            taken = take_run(dict(getattr(together, part).flatten_keys(".")), run, 2)
            assert all(torch.allclose(taken[key], expected[key], atol=1e-6) for key in expected)


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
    critic = make_critic((4, 2), 3, hidden=16)
    action = Bounded(-1.0, 1.0, shape=(3,))
    if kind == "td3":
        loss = TD3Loss(make_actor((4, 2), 3, hidden=16), critic, action_spec=action)
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


def test_several_steps_of_one_call_are_those_of_several_calls() -> None:
    torch.manual_seed(0)
    loss = constant_loss(-4.0, gamma=0.5)
    together = LossLearner(loss, torch.optim.Adam(loss.parameters(), lr=0.1), SoftUpdate(loss, tau=0.5))
    other = deepcopy(loss)
    apart = LossLearner(other, torch.optim.Adam(other.parameters(), lr=0.1), SoftUpdate(other, tau=0.5))
    data = rows([-1.0, 0.0, -1.0, -1.0], terminated=[0, 1, 0, 1])
    halves = [data[:2].clone(), data[2:].clone()]
    measured = together.update(data, 2)
    losses = [apart.update(half)["loss_value"] for half in halves]
    assert measured["loss_value"].tolist() == torch.cat(losses).tolist()
    assert data["td_error"].tolist() == torch.cat([half["td_error"] for half in halves]).tolist()
    for ours, theirs in zip(loss.parameters(), other.parameters(), strict=True):
        assert torch.equal(ours, theirs)


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


def test_a_critic_may_write_its_value_elsewhere() -> None:
    losses = []
    for key in ("state_action_value", "q"):
        torch.manual_seed(0)
        loss = make_ddpg_loss(make_actor((2, 2), 1), make_critic((2, 2), 1, value=key))
        losses.append(loss(make_batch([[6]]).squeeze(0))["loss_value"])
    assert torch.equal(*losses)


@pytest.mark.parametrize("fused", [False, True])
@pytest.mark.parametrize("steps", [0, 3])
def test_rows_must_be_whole_batches(fused: bool, steps: int) -> None:
    loss = make_ddpg_loss(make_actor((2, 2), 1), make_critic((2, 2), 1))
    make = FusedDDPGLearner if fused else LossLearner
    learner = make(loss, torch.optim.Adam(loss.parameters()), SoftUpdate(loss, tau=0.1))
    with pytest.raises(ValueError, match=f"10 rows cannot be shared out among {steps} gradient steps"):
        learner.update(make_batch([[10]]), steps)
