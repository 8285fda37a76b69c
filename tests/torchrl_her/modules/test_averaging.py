"""Averaged policies."""

from __future__ import annotations

import io

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn

from torchrl_her import make_actor
from torchrl_her.modules import PolicyAverage


def make_policy(weight: float) -> TensorDictModule:
    layer = nn.Linear(1, 1, bias=False)
    nn.init.constant_(layer.weight, weight)
    return TensorDictModule(layer, in_keys=["observation"], out_keys=["action"])


def set_weight(policy: TensorDictModule, weight: float) -> None:
    nn.init.constant_(policy.module.weight, weight)  # type: ignore[arg-type]


def weight_of(average: PolicyAverage) -> float:
    return float(next(average.module.parameters()))


def test_by_hand() -> None:
    policy = make_policy(0.0)
    average = PolicyAverage(policy, decay=0.5)
    set_weight(policy, 1.0)
    average.follow()  # decay (1 + 1) / (10 + 1)
    assert weight_of(average) == pytest.approx(9 / 11)
    average.follow(2)  # (1 + 3) / (10 + 3), twice
    assert weight_of(average) == pytest.approx(1 - 2 / 11 * (4 / 13) ** 2)
    average.follow(100)  # from here on the decay is its own
    set_weight(policy, 3.0)
    average.follow(2)
    assert weight_of(average) == pytest.approx(1 + 2 * 0.75)


def test_the_policy_and_its_gradients_are_left_alone() -> None:
    actor = make_actor((4, 2), 3)
    average = PolicyAverage(actor)
    before = [parameter.clone() for parameter in actor.parameters()]
    average.follow()
    assert all(torch.equal(one, other) for one, other in zip(before, actor.parameters(), strict=True))
    assert average.policy is actor
    assert not any("policy" in name for name, _ in average.named_modules())


def test_the_average_acts_like_the_policy() -> None:
    actor = make_actor((4, 2), 3, runs=2)
    seen = TensorDict({"observation": torch.randn(6, 4), "desired_goal": torch.randn(6, 2)}, [6])
    average = PolicyAverage(actor)
    torch.testing.assert_close(average.module(seen.clone())["action"], actor(seen.clone())["action"])


def test_it_goes_on_from_its_state() -> None:
    policy = make_policy(0.0)
    average = PolicyAverage(policy)
    set_weight(policy, 1.0)
    average.follow(3)
    file = io.BytesIO()
    torch.save(average.state_dict(), file)
    file.seek(0)
    other = PolicyAverage(policy)
    other.load_state_dict(torch.load(file, weights_only=True))
    for own in (average, other):
        own.follow(2)
    assert weight_of(average) == weight_of(other) != 1.0


def moved(average: PolicyAverage, steps: int, *, idle: tuple[int, ...] = ()) -> None:
    """As if the policy's weights had grown by 1 in some gradient steps."""
    for parameter in average.policy.parameters():
        parameter.data += 1.0
    average.follow(steps, idle=idle)


def test_each_run_is_averaged_over_its_own_steps() -> None:
    both, alone = (PolicyAverage(make_actor((4, 2), 3, runs=runs), decay=0.99, runs=runs) for runs in (2, 1))
    for stacked, own in zip(both.policy.parameters(), alone.policy.parameters(), strict=True):
        stacked.data[1:] = own.data
    for average in (both, alone):
        average.restart()
    before = next(both.module.parameters())[1].clone()
    moved(both, 500, idle=(1,))
    assert torch.equal(next(both.module.parameters())[1], before)
    for stacked, own in zip(both.policy.parameters(), alone.policy.parameters(), strict=True):
        stacked.data[1:] = own.data
    moved(both, 3)
    moved(alone, 3)
    assert both.steps.tolist() == [503, 3]
    for stacked, own in zip(both.module.parameters(), alone.module.parameters(), strict=True):
        torch.testing.assert_close(stacked[1:], own)
        assert not torch.equal(stacked[:1], own)


def test_weights_that_are_not_stacked_are_refused() -> None:
    with pytest.raises(ValueError, match=r"the weights of 3 runs must be stacked, got a parameter \[1, 1\]"):
        PolicyAverage(make_policy(0.0), runs=3)


def test_a_restart_forgets_what_was() -> None:
    policy = make_policy(0.0)
    average = PolicyAverage(policy)
    set_weight(policy, 1.0)
    average.follow(2)
    set_weight(policy, 5.0)
    average.restart()
    assert (weight_of(average), average.steps.tolist()) == (5.0, [0])


def test_statistics_follow_a_policy_that_was_cast() -> None:
    policy = make_policy(0.0)
    policy.register_buffer("seen", torch.zeros(()))
    average = PolicyAverage(policy)
    policy.double()
    average.double()
    policy.seen.fill_(5.0)  # type: ignore[union-attr, operator]
    average.follow()
    assert float(average.module.seen) == 5.0


@pytest.mark.parametrize("decay", [0.0, 1.0, -0.1, float("nan")])
def test_a_decay_that_cannot_be(decay: float) -> None:
    with pytest.raises(ValueError, match=f"decay must be between 0 and 1, got {decay}"):
        PolicyAverage(make_policy(0.0), decay=decay)
