"""Runs with normalized inputs: acting, learning and measuring see the same statistics; rows stay raw."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from torchrl_her.modules import NormalizedPolicy, RunningNorm
from torchrl_her.objectives import critic_value
from torchrl_her.replay_buffers import rows_of_run
from torchrl_her_recipes import Components, build, make_recipe, run
from torchrl_her_recipes.runs.curriculum import move_on, play_greedily
from torchrl_her_recipes.runs.evaluation import measure

from ..small import small

KEYS = ("observation", "desired_goal")


def trained(**options: Any) -> tuple[Components, RunningNorm, NormalizedPolicy]:
    components = build(small(**{"normalize": True, "epochs": 1, "algo": "her", **options}))
    run(components, progress=False)
    assert isinstance(components.actor, NormalizedPolicy)
    return components, components.norm, components.actor


def test_statistics_of_each_run_are_those_of_its_rows() -> None:
    components, norm, _ = trained(num_runs=2, task="robot_v0")
    for number in range(2):
        rows = rows_of_run(components.buffer, number)
        assert rows["virtual"].any()
        for key in KEYS:
            n, mean, var = norm.moments_of(key, number)
            assert n.tolist() == [len(rows)] * len(mean)
            torch.testing.assert_close(mean, rows[key].double().mean(0), atol=1e-6, rtol=1e-6)
            torch.testing.assert_close(var, rows[key].double().var(0, correction=0), atol=1e-6, rtol=1e-6)
    assert not torch.equal(norm.moments_of("observation", 0).mean, norm.moments_of("observation", 1).mean)


@pytest.mark.parametrize(
    ("task", "learner"), [("hand_v0", "ddpg"), ("hand_v0", "td3"), ("hand_v0", "sac"), ("bit_flip", "dqn")]
)
def test_learners_act_and_learn_on_normalized_entries(task: str, learner: str) -> None:
    components, norm, actor = trained(task=task, learner=learner)
    drawn = components.buffer.sample(256)
    raw = components.buffer.storage[drawn["index"]]
    for key in KEYS:
        for where in (key, ("next", key)):
            torch.testing.assert_close(drawn[where], norm.normalize(key, raw[where]))
    rollout = play_greedily(components, components.eval_env, 0)
    shown = rollout.select(*KEYS)[:, 7]
    with torch.no_grad():
        batch = norm(shown)
        assert not torch.allclose(batch["observation"], shown["observation"])
        if learner != "sac":  # whose actor draws
            assert torch.equal(actor(shown)["action"], actor.actor(batch)["action"])


def test_q_and_its_bias_are_of_normalized_states() -> None:
    components, norm, _ = trained()
    rollout = play_greedily(components, components.eval_env, 0)
    start = rollout[:, 0]
    value = critic_value(components.loss, norm(start))
    measured = measure(components, rollout)
    torch.testing.assert_close(measured["q"], value.mean().view(1))
    torch.testing.assert_close(measured["q_bias"], (value.mean() - measured["return"]).view(1))
    other = critic_value(components.loss, start)
    assert not torch.allclose(value, other)


def test_evaluation_leaves_the_statistics_as_they_are() -> None:
    components, norm, _ = trained()
    before = {key: value.clone() for key, value in norm.state_dict().items()}
    play_greedily(components, components.eval_env, 0)
    assert all(torch.equal(before[key], value) for key, value in norm.state_dict().items())


def test_normalization_is_an_option() -> None:
    components = build(small(normalize=False))
    assert components.norm is None
    assert not isinstance(components.actor, NormalizedPolicy)
    assert len(components.buffer.transform) == 0
    norm = build(small(normalize=True, normalize_clip=3.0)).norm
    assert norm.clip == 3.0
    with pytest.raises(ValueError, match=r"normalize_clip must be above 0, got 0\.0"):
        make_recipe(normalize=True, normalize_clip=0.0)


# In a curriculum


def test_inputs_of_a_stage_are_normalized_by_the_rows_of_that_stage() -> None:
    components, norm, _ = trained(task="hand_v1", algo="cher", num_runs=2, window=50)
    assert norm.keys == ["input"]
    for number in range(2):
        rows = rows_of_run(components.buffer, number)
        used = torch.cat(
            (rows["observation"][:, :5], rows["desired_goal"]), -1
        ).double()  # the hand, the ball
        n, mean, var = norm.moments_of("input", number)
        assert n.tolist() == [len(rows)] * 7 + [0.0] * 4
        torch.testing.assert_close(mean[:7], used.mean(0), atol=1e-6, rtol=1e-6)
        torch.testing.assert_close(var[:7], used.var(0, correction=0), atol=1e-6, rtol=1e-6)
    drawn = components.buffer.sample(256)
    raw = components.buffer.storage[drawn["index"]]
    inputs = torch.cat((raw["observation"][:, :5], raw["desired_goal"], torch.zeros(256, 4)), -1)
    torch.testing.assert_close(drawn["input"], norm.normalize("input", inputs))
    assert torch.equal(drawn["observation"], raw["observation"])


def test_a_stage_begins_with_the_statistics_of_what_still_means_the_same() -> None:
    components, norm, _ = trained(task="hand_v1", algo="cher", num_runs=2, window=10)
    before = norm.n.clone()
    samples = torch.tensor([[0.0], [1.0]]).expand(2, 10)
    (line,) = move_on(components, components.curriculum, samples, 100)
    assert line == "seed 1: 'reach' learned after 100 frames, 'throw' begins"
    assert torch.equal(norm.n[0], before[0])
    assert norm.n[1].tolist() == before[1].tolist()  # the ball, the goal of the first stage, is seen now
    norm.n.fill_(3.0)
    components.curriculum.progress.set_stage(1, 0)
    move_on(components, components.curriculum, samples, 100)
    assert norm.n.tolist() == [[3.0] * 11, [3.0] * 7 + [0.0] * 4]
