"""Networks and losses of DQN, TD3 and SAC."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import SoftUpdate

from torchrl_her import (
    LossLearner,
    QNet,
    StochasticActorNet,
    make_actor,
    make_critic,
    make_dqn_loss,
    make_q_actor,
    make_sac_loss,
    make_stochastic_actor,
    make_td3_loss,
)

SPEC = Bounded(-2.0, 2.0, (3,))


def rows(n: int, *, action: torch.Tensor, runs: int = 1) -> TensorDict:
    def seen() -> dict[str, torch.Tensor]:
        return {"observation": torch.randn(runs, n, 4), "desired_goal": torch.randn(runs, n, 2)}

    off = torch.zeros(runs, n, 1, dtype=torch.bool)
    after = seen() | {"reward": -torch.ones(runs, n, 1), "done": off, "terminated": off.clone()}
    return TensorDict(seen() | {"action": action, "next": after}, [runs, n])


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


def test_dqn_targets_are_double_and_clamped() -> None:
    """By hand: the online network chooses action 1, whose value by the target network is -7."""
    actor, _ = make_q_actor((4, 2), 2)
    loss = make_dqn_loss(actor, gamma=0.5)
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


@pytest.mark.parametrize("runs", [1, 2])
def test_dqn_learns_the_value_of_a_lost_game(runs: int) -> None:
    torch.manual_seed(0)
    actor, _ = make_q_actor((4, 2), 3, runs=runs)
    loss = make_dqn_loss(actor, gamma=0.5, reduction="none")
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


@pytest.mark.parametrize("name", ["td3", "sac"])
def test_two_critics_learn_the_value_of_a_lost_game(name: str) -> None:
    torch.manual_seed(0)
    critic = make_critic((4, 2), 3)
    if name == "td3":
        loss = make_td3_loss(make_actor((4, 2), 3), critic, action_spec=SPEC, gamma=0.5)
    else:
        loss = make_sac_loss(make_stochastic_actor((4, 2), SPEC), critic, action_spec=SPEC, gamma=0.5)
    learner = LossLearner(loss, torch.optim.Adam(loss.parameters(), lr=3e-3), SoftUpdate(loss, tau=0.1))
    for _ in range(150):
        batch = rows(64, action=torch.rand(1, 64, 3) * 4 - 2)[0]
        measured = learner.update(batch)
    assert float(measured["loss_qvalue"]) < 0.5
    assert batch["td_error"].shape == (64,)
    if name == "td3":
        assert float(loss(batch)["pred_value"].mean()) == pytest.approx(-2.0, abs=0.3)


@pytest.mark.parametrize("gamma", [-0.1, 1.0])
def test_a_discount_out_of_range_is_named(gamma: float) -> None:
    actor, critic = make_stochastic_actor((4, 2), SPEC), make_critic((4, 2), 3)
    with pytest.raises(ValueError, match=rf"gamma must be in \[0, 1\), got {gamma}"):
        make_sac_loss(actor, critic, action_spec=SPEC, gamma=gamma)
    with pytest.raises(ValueError, match="gamma must be"):
        make_td3_loss(make_actor((4, 2), 3), critic, action_spec=SPEC, gamma=gamma)
    with pytest.raises(ValueError, match="gamma must be"):
        make_dqn_loss(make_q_actor((4, 2), 3)[0], gamma=gamma)
