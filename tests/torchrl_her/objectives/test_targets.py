"""One-step targets by hand, and how target networks move."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.objectives import HardUpdate, LossModule, SoftUpdate

from torchrl_her import LossLearner, make_actor, make_critic, make_ddpg_loss, make_target_updater
from torchrl_her.modules import NetworkShape
from torchrl_her.objectives import Targets

from ..ddpg_data import batch, constant_loss, make_loss, rows, weights

# Most of these tests ask a loss for its numbers, and have no target networks to move.
pytestmark = pytest.mark.filterwarnings("ignore:No target network updater has been associated")


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


def test_targets_are_clamped_to_what_is_possible() -> None:
    assert constant_loss(-200.0)(rows([-1.0]))["target_value"].item() == pytest.approx(-50.0)
    assert constant_loss(100.0)(rows([-1.0]))["target_value"].item() == 0.0
    assert constant_loss(-49.0)(rows([-1.0]))["target_value"].item() == pytest.approx(-49.02)


@pytest.mark.parametrize("value", [-200.0, -49.0, 100.0])
def test_targets_may_be_left_as_they_are(value: float) -> None:
    loss = constant_loss(value, reward_range=None)
    assert loss(rows([-1.0]))["target_value"].item() == pytest.approx(-1.0 + 0.98 * value)


@pytest.mark.parametrize(
    ("reward_range", "low", "high"),
    [((-1.0, 0.0), -2.0, 0.0), ((0.0, 1.0), 0.0, 2.0), ((-2.0, 3.0), -4.0, 6.0), ((1.0, 2.0), 1.0, 4.0)],
)
def test_bounds_of_targets(reward_range: tuple[float, float], low: float, high: float) -> None:
    for value, expected in ((-1000.0, low), (1000.0, high)):
        loss = constant_loss(value, gamma=0.5, reward_range=reward_range)
        assert loss(rows([0.0]))["target_value"].item() == expected


def test_rows_of_several_steps_discount_the_next_value_by_their_number() -> None:
    data = rows([-1.0, -1.5, -1.75, -1.5], terminated=[0, 0, 0, 1])
    data["steps_to_next_obs"] = torch.tensor([[1], [2], [3], [2]])
    target = constant_loss(-6.0, gamma=0.5, reward_range=(-10.0, 0.0))(data)["target_value"]
    assert target.tolist() == [-4.0, -3.0, -2.5, -1.5]  # -1 - 6 / 2, -1.5 - 6 / 4, -1.75 - 6 / 8


def test_rows_of_several_steps_are_clamped_to_the_same_bounds() -> None:
    data = rows([-1.5, -1.5])
    data["steps_to_next_obs"] = torch.tensor([[2], [2]])
    loss = constant_loss(-100.0, gamma=0.5)
    assert loss(data)["target_value"].tolist() == [-2.0, -2.0]  # -1.5 - 100 / 4, and -1 / (1 - 0.5)
    assert constant_loss(100.0, gamma=0.5)(data)["target_value"].tolist() == [0.0, 0.0]


@pytest.mark.parametrize("gamma", [1.0, -0.1])
def test_a_discount_out_of_range_is_named(gamma: float) -> None:
    with pytest.raises(ValueError, match=rf"gamma must be in \[0, 1\), got {gamma}"):
        Targets(gamma=gamma, reward_range=None)


def test_the_priority_is_the_square_of_the_error() -> None:
    # Priorities get half of Schaul's alpha because of this: should TorchRL change it, so must that.
    data = rows([-1.0, -1.0], terminated=[1, 0])
    out = constant_loss(-4.0, gamma=0.5)(data)
    assert data["td_error"].tolist() == [9.0, 4.0]  # -4 against -1, and against -2: -1 - 0.5 * 4, clamped
    assert out["loss_value"].item() == 6.5


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
    assert isinstance(make_target_updater(make_loss(), tau=0.1, hard_interval=0), SoftUpdate)
    assert isinstance(make_target_updater(make_loss(), tau=0.1, hard_interval=5), HardUpdate)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tau": 0.0}, r"tau must be in \(0, 1\] in soft updates, got 0.0"),
        ({"tau": 1.5}, r"tau must be in \(0, 1\] in soft updates, got 1.5"),
        ({"hard_interval": 2.5}, "hard_interval must be a whole number, got 2.5"),
        ({"hard_interval": -10}, "hard_interval must be at least 0, got -10"),
        ({"hard_interval": 5, "runs": 0}, "runs must be at least 1, got 0"),
    ],
)
def test_numbers_that_would_never_move_a_target_are_named(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_target_updater(make_loss(), **{"tau": 0.5, "hard_interval": 0} | options)


# Batch normalization

MEAN = ("module", "first", "0", "running_mean")


@pytest.mark.parametrize(
    ("hard_interval", "expected"), [(0, [(0.3, 0.15), (0.57, 0.36)]), (2, [(0.3, 0.0), (0.57, 0.57)])]
)
def test_statistics_move_once_a_step_and_those_of_the_target_follow(
    hard_interval: int, expected: list[tuple[float, float]]
) -> None:
    loss = make_ddpg_loss(make_actor((4, 2), 3), make_critic((4, 2), 3, shape=NetworkShape(norm="batch")))
    target = make_target_updater(loss, tau=0.5, hard_interval=hard_interval)
    learner = LossLearner(loss, torch.optim.SGD(loss.parameters(), lr=0.0), target)
    data = rows([-1.0, -1.0])
    data["observation"] = torch.tensor([[2.0], [4.0]]).expand(2, 4)
    for means in expected:  # momentum 0.1, towards 3: the mean of the batch, in the critic's own loss alone
        learner.update(data)
        networks = (loss.value_network_params, loss.target_value_network_params)
        assert [params[MEAN][0, 0, 0].item() for params in networks] == pytest.approx(list(means))


class OwnCritic(nn.Module):
    """A critic with a count of batches, which is a whole number, and a weight without a dimension."""

    def __init__(self) -> None:
        super().__init__()
        self.norm, self.linear, self.scale = (
            nn.BatchNorm1d(9),
            nn.Linear(9, 1),
            nn.Parameter(torch.tensor(2.0)),
        )

    def forward(self, *inputs: Tensor) -> Tensor:
        return self.linear(self.norm(torch.cat(inputs, -1))) * self.scale


@pytest.mark.parametrize(("hard_interval", "moved"), [(0, 0.5), (1, 1.0)])
def test_targets_of_networks_from_elsewhere_follow(hard_interval: int, moved: float) -> None:
    seen = ["observation", "desired_goal", "action"]
    loss = make_ddpg_loss(
        make_actor((4, 2), 3), TensorDictModule(OwnCritic(), in_keys=seen, out_keys=["state_action_value"])
    )
    target = make_target_updater(loss, tau=0.5, hard_interval=hard_interval)
    online, delayed = loss.value_network_params.data, loss.target_value_network_params.data
    for key, start in (("scale", 2.0), (("norm", "running_mean"), 0.0)):
        online["module"][key].fill_(4.0)
        target.step()
        assert (delayed["module"][key] == start + moved * (4.0 - start)).all()
