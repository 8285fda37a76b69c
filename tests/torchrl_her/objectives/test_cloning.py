"""Behavior cloning: its terms by hand, in each loss, and for each run by itself."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import Bounded
from torchrl.objectives import LossModule

from torchrl_her import make_actor, make_critic, make_ddpg_loss, make_target_updater
from torchrl_her.modules import make_stochastic_actor, stack_runs
from torchrl_her.objectives import (
    ActorTerms,
    Cloning,
    PenalizedDDPGLoss,
    cloning_terms,
    make_sac_loss,
    make_td3_loss,
    make_tqc_loss,
)
from torchrl_her.trainers import LossLearner, why_not_fused, why_not_recorded

from ..ddpg_data import batch

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater has been associated")

SPEC = Bounded(-1.0, 1.0, (3,))


def flagged(count: int, data: TensorDict) -> TensorDict:
    """Rows whose last ones are demonstrations."""
    flag = torch.zeros(*data.shape, 1, dtype=torch.bool)
    flag[..., data.shape[-1] - count :, :] = True
    return data.set("demonstration", flag)


# The terms


def test_the_terms_sum_to_the_mean_over_demonstrations() -> None:
    action = torch.tensor([[0.0, 0.0], [1.0, 0.0], [5.0, 5.0]])
    shown = torch.tensor([[3.0, 4.0], [1.0, 2.0], [0.0, 0.0]])
    both = torch.tensor([True, True, False])
    assert cloning_terms(action, shown, both).tolist() == [12.5, 2.0, 0.0]  # 25 / 2 and 4 / 2
    better = torch.tensor([True, False, True])
    assert cloning_terms(action, shown, both, better=better).tolist() == [12.5, 0.0, 0.0]
    assert cloning_terms(action, shown, both & False).tolist() == [0.0, 0.0, 0.0]


def test_each_block_of_rows_has_a_mean_of_its_own() -> None:
    action, shown = torch.zeros(2, 2, 1), torch.tensor([[[1.0], [3.0]], [[2.0], [7.0]]])
    one_or_two = torch.tensor([[True, True], [True, False]])
    assert cloning_terms(action, shown, one_or_two).tolist() == [[0.5, 4.5], [4.0, 0.0]]


# The filter, with a critic whose values are known


class Slope(nn.Module):
    """The value of an action, which is the better the greater it is; or the smaller."""

    def __init__(self, slope: float) -> None:
        super().__init__()
        self.slope = nn.Parameter(torch.tensor(slope))

    def forward(self, _observation: Tensor, action: Tensor) -> Tensor:
        return self.slope * action


class Constant(nn.Module):
    """Always the same action."""

    def __init__(self, action: float) -> None:
        super().__init__()
        self.action = nn.Parameter(torch.tensor([action]))

    def forward(self, observation: Tensor) -> Tensor:
        return self.action.expand(*observation.shape[:-1], 1)


def linear_loss(slope: float, **options: Any) -> PenalizedDDPGLoss:
    actor = TensorDictModule(Constant(0.5), ["observation"], ["action"])
    critic = TensorDictModule(Slope(slope), ["observation", "action"], ["state_action_value"])
    return PenalizedDDPGLoss(
        actor, critic, delay_actor=True, delay_value=True, terms=ActorTerms(cloning=Cloning(**options))
    )


def rows(*actions: float) -> TensorDict:
    n = len(actions)
    data = TensorDict({"observation": torch.zeros(n, 1), "action": torch.tensor(actions).unsqueeze(-1)}, [n])
    return data


@pytest.mark.parametrize(
    ("slope", "q_filter", "expected"),
    [
        (2.0, True, 0.125),  # only 1.0 is better than 0.5: 0.25 / 2
        (-2.0, True, 0.5),  # only -0.5 is: 1 / 2
        (2.0, False, 0.625),  # (0.25 + 1) / 2
        (0.0, True, 0.0),  # none is better
    ],
)
def test_only_actions_that_the_critic_prefers_are_cloned(
    slope: float, q_filter: bool, expected: float
) -> None:
    data = flagged(2, rows(0.9, 1.0, -0.5))
    loss = linear_loss(slope, weight=1.0, q_filter=q_filter)
    value, _ = loss.loss_actor(data)
    assert value.item() == pytest.approx(-slope * 0.5 + expected)
    tripled, _ = linear_loss(slope, weight=3.0, q_filter=q_filter).loss_actor(data)
    assert tripled.item() == pytest.approx(-slope * 0.5 + 3 * expected)


def test_the_gradient_goes_to_the_action_alone() -> None:
    loss = linear_loss(2.0, q_filter=True)
    value, _ = loss.loss_actor(flagged(2, rows(0.9, 1.0, -0.5)))
    value.backward()
    gradients = {name: p.grad for name, p in loss.named_parameters()}
    assert gradients.pop("actor_network_params.module.action").item() == pytest.approx(-2.0 - 0.5)
    assert all(own is None for own in gradients.values())


def test_without_demonstrations_it_is_the_plain_loss() -> None:
    value, _ = linear_loss(2.0).loss_actor(flagged(0, rows(0.9, 1.0)))
    assert value.item() == pytest.approx(-1.0)


def test_rows_without_the_flag_are_refused() -> None:
    with pytest.raises(KeyError, match="behavior cloning needs the flag 'demonstration' in each row"):
        linear_loss(2.0).loss_actor(rows(0.9))


def test_a_negative_weight_is_refused() -> None:
    with pytest.raises(
        ValueError, match="the weight of behavior cloning must be at least 0 and finite, got -1"
    ):
        Cloning(weight=-1.0)


# In each loss


def make_loss(name: str, runs: int, cloning: Cloning | None, *, seed: int = 0) -> LossModule:
    """A loss of some runs, each with the weights that it has alone."""
    shape: Any = ((4, 2), SPEC) if name in ("sac", "tqc") else ((4, 2), 3)
    make: Any = make_stochastic_actor if name in ("sac", "tqc") else make_actor
    outputs = {"outputs": 5} if name == "tqc" else {}
    count = 1 if name == "ddpg" else 2

    def networks(runs: int) -> list[Any]:
        critics = [make_critic((4, 2), 3, runs=runs, **outputs) for _ in range(count)]
        return [make(*shape, runs=runs), *critics]

    alone = []
    for run in range(runs):
        torch.manual_seed(seed + run)
        alone.append(networks(1))
    every = networks(runs)
    for network, own in zip(every, zip(*alone, strict=True), strict=True):
        network.load_state_dict(stack_runs([single.state_dict() for single in own]))
    generators = [torch.Generator().manual_seed(seed + run) for run in range(runs)]
    options: dict[str, Any] = {"reduction": "none", "terms": ActorTerms(cloning=cloning)}
    if name == "ddpg":
        return make_ddpg_loss(*every, **options)
    if name == "td3":
        return make_td3_loss(every[0], every[1:], action_spec=SPEC, generators=generators, **options)
    maker = make_sac_loss if name == "sac" else make_tqc_loss
    every[0].generators = generators
    return maker(every[0], every[1:], **options)


def learner(loss: LossModule, runs: int) -> LossLearner:
    target = make_target_updater(loss, tau=0.01, hard_interval=0)
    return LossLearner(loss, torch.optim.Adam(loss.parameters(), lr=1e-2), target, runs=runs)


NAMES = ["ddpg", "td3", "sac", "tqc"]


@pytest.mark.parametrize("q_filter", [True, False])
@pytest.mark.parametrize("name", NAMES)
def test_runs_side_by_side_learn_as_if_alone(name: str, q_filter: bool) -> None:
    data = [flagged(3, batch(8)) for _ in range(2)]
    data[1]["demonstration"][2] = True  # another number of them
    cloning = Cloning(weight=2.0, q_filter=q_filter)
    together = make_loss(name, 2, cloning)
    both = learner(together, 2).update(torch.stack([own.clone() for own in data]))
    for run in range(2):
        alone = make_loss(name, 1, cloning, seed=run)
        own = learner(alone, 1).update(data[run].clone().unsqueeze(0))
        for key in own:
            torch.testing.assert_close(both[key][:, run], own[key][:, 0], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", NAMES)
def test_cloning_adds_the_mean_square_of_what_the_greedy_action_misses(name: str) -> None:
    data = flagged(3, batch(8)).unsqueeze(0)
    plain, cloned = make_loss(name, 1, None), make_loss(name, 1, Cloning(weight=2.0, q_filter=False))
    losses = [learner(loss, 1).update(data.clone())["loss_actor"].item() for loss in (plain, cloned)]
    actor: Any = make_loss(name, 1, None).actor_network
    fresh = make_loss(name, 1, None)
    with fresh.actor_network_params.to_module(actor, preserve_module_state=False):
        seen = actor(data[0, 5:].select("observation", "desired_goal"))
    action = torch.tanh(seen["loc"]) if "loc" in seen.keys() else seen["action"]
    missed = (action - data[0, 5:]["action"]).square().sum(-1).mean().item()
    assert losses[1] - losses[0] == pytest.approx(2.0 * missed, rel=1e-4)


@pytest.mark.parametrize("name", NAMES)
def test_the_policy_comes_to_do_what_was_demonstrated(name: str) -> None:
    data = flagged(8, batch(8)).unsqueeze(0)
    data["action"] = data["action"].clamp(-0.9, 0.9)
    loss = make_loss(name, 1, Cloning(weight=100.0, q_filter=False))
    own = learner(loss, 1)
    before = own.update(data.clone())["loss_actor"].item()
    for _ in range(60):
        after = own.update(data.clone())["loss_actor"].item()
    assert after < before / 3


def test_compiled_steps_say_that_they_have_no_cloning() -> None:
    loss = make_loss("ddpg", 1, Cloning())
    target = make_target_updater(loss, tau=0.01, hard_interval=0)
    assert (
        why_not_fused(loss, target) == "behavior cloning of demonstrations, which the C++ steps do not have"
    )
    assert "behavior cloning of demonstrations" in str(why_not_recorded(loss, target))
