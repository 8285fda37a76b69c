"""Networks of exported policies, made from cards and weights."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_her_recipes.components.envs import TaskEnvs
from torchrl_her_recipes.policies.network import TensorPolicy, load_network

from .tiny import LEARNERS, make_player, states, tiny_policy


@pytest.mark.parametrize("options", LEARNERS, ids=lambda options: options["learner"])
def test_the_policy_is_the_learner_s_own_greedy_one(options: dict[str, Any]) -> None:
    policy = tiny_policy(**options)
    seen = states(policy.info, 50)
    env = TaskEnvs.of(policy.recipe).make(1, [0])
    own = make_player(policy.recipe, env)
    with torch.no_grad():
        for weight in own.parameters():
            weight.copy_(0.5 * torch.randn_like(weight))
        loaded, _ = load_network(policy.info, policy.recipe.learner, own.state_dict())
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            wanted = own(seen.clone())["action"]
        with set_exploration_type(ExplorationType.RANDOM):  # it stays greedy
            written = loaded(seen.clone())
    assert set(written.keys()) == {"observation", "desired_goal", "action"}
    torch.testing.assert_close(written["action"], wanted, atol=2e-6, rtol=0)
    assert len(written["action"].unique(dim=0)) > 1


@pytest.mark.parametrize("learner", ["ddpg", "sac"])
def test_actions_reach_the_limits_of_the_task(learner: str) -> None:
    policy = tiny_policy(learner=learner, normalize=False, norm="none", scale=3.0)  # from -3 to 6
    far = states(policy.info, 200).apply(lambda own: 100 * own)
    action = policy.module(far)["action"]
    assert float(action.min()) == pytest.approx(-3.0, abs=1e-4)
    assert float(action.max()) == pytest.approx(6.0, abs=1e-4)


def test_tensors_alone_give_the_same_actions() -> None:
    policy = tiny_policy(normalize=True, normalize_clip=1.5)
    seen = states(policy.info, 100, mean=3.0)
    own = TensorPolicy(policy.module)
    action = own(seen["observation"], seen["desired_goal"])
    torch.testing.assert_close(action, policy.module(seen.clone())["action"])
    wrong = action.clone()
    wrong[7, 1] += 0.25
    deviation = own.deviation(wrong, seen["observation"], seen["desired_goal"])
    assert float(deviation[7]) == pytest.approx(0.25, abs=1e-6)
    assert float(deviation.sum()) == pytest.approx(0.25, abs=1e-5)


def test_integers_deviate_by_their_value() -> None:
    policy = tiny_policy(task="bit_flip", learner="dqn", normalize=False)
    seen = states(policy.info, 5)
    own = TensorPolicy(policy.module)
    values = own.net.net(seen["observation"], seen["desired_goal"])
    second = values.topk(2).indices[:, 1]
    gap = values.topk(2).values[:, 0] - values.topk(2).values[:, 1]
    torch.testing.assert_close(own.deviation(second, seen["observation"], seen["desired_goal"]), gap)


def test_weights_of_something_else_are_refused_before_memory_is_taken() -> None:
    policy = tiny_policy()
    env = TaskEnvs.of(policy.recipe).make(1, [0])
    weights = make_player(policy.recipe, env).state_dict()
    wide = policy.recipe.replace(hidden=10_000_000)
    with pytest.raises(ValueError, match=r"layers.0.0.weight must be \(1, 11, 10000000\), got \(1, 11, 8\)"):
        load_network(policy.info, wide.learner, weights)
    with pytest.raises(ValueError, match="not the weights of an actor of learner=auto"):
        load_network(policy.info, policy.recipe.replace(depth=1_000_000).learner, weights)
    with pytest.raises(ValueError, match="is no option|actions"):
        load_network(policy.info, policy.recipe.replace(learner="dqn", task="bit_flip").learner, weights)
