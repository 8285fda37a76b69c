"""What is evaluated and kept is the average of the actor's weights; what collects and learns is not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from torchrl_her.modules import PolicyAverage, take_run
from torchrl_her_recipes import Components, build, run
from torchrl_her_recipes.runs.curriculum import play_greedily
from torchrl_her_recipes.runs.evaluation import measure
from torchrl_her_recipes.runs.policy_file import read_policy

from ..small import small


def trained(**options: Any) -> tuple[Components, PolicyAverage]:
    components = build(small(**{"epochs": 1, "algo": "her", **options}))
    run(components, progress=False)
    return components, components.average


def test_the_average_is_what_plays_and_is_kept(tmp_path: Path) -> None:
    components = build(small(epochs=1))
    run(components, tmp_path / "run", progress=False)
    assert components.greedy is components.average.module
    _, kept = read_policy(tmp_path / "run" / "policy.safetensors")
    for name, value in components.average.module.state_dict().items():
        assert torch.equal(kept[name], value)
    assert not all(torch.equal(kept[name], own) for name, own in components.actor.state_dict().items())
    rollout = play_greedily(components, components.eval_env, 0)
    shown = rollout.select("observation", "desired_goal")[:, 3]
    torch.testing.assert_close(components.average.module(shown)["action"], rollout["action"][:, 3])


def test_actions_that_are_collected_are_the_actors_own() -> None:
    components, _ = trained(epsilon_start=0.0, epsilon_end=0.0)
    batch = components.collector.next()
    own = components.actor(batch.select("observation", "desired_goal").flatten())["action"]
    torch.testing.assert_close(own, batch["action"].flatten(0, 1))


def test_without_an_average_the_last_weights_play() -> None:
    components = build(small(ema_decay=0.0))
    assert components.average is None
    assert components.greedy is components.actor
    assert components.trainer().average is None


def test_an_actor_of_ones_own_is_not_hidden_by_the_average() -> None:
    components = build(small())
    components.actor = build(small(seed=4)).actor
    assert components.greedy is components.actor


def test_values_of_discrete_actions_are_those_of_the_network_that_learns() -> None:
    components, average = trained(task="bit_flip", learner="dqn")
    rollout = play_greedily(components, components.eval_env, 0)
    before = measure(components, rollout)
    for parameter in average.module.parameters():
        parameter.mul_(-1.0)
    for name, value in measure(components, rollout).items():
        torch.testing.assert_close(value, before[name], equal_nan=True)


def test_each_run_has_the_average_that_it_would_have_alone() -> None:
    options = {"dtype": "float64", "epochs": 2, "ema_decay": 0.99}
    _, together = trained(num_runs=2, seed=5, **options)
    _, alone = trained(seed=6, **options)
    assert together.steps[1] == alone.steps[0] > 0
    state = take_run(together.module.state_dict(), 1, 2)
    for name, value in alone.module.state_dict().items():
        torch.testing.assert_close(state[name], value, rtol=1e-7, atol=1e-9)
