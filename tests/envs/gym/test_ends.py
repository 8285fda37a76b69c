"""Environments that do not say which goals end an episode, that end by themselves, or have dense rewards."""

from __future__ import annotations

import logging
import re
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from torchrl.envs.utils import check_env_specs

from torchrl_her_envs import GymGoalEnv, make_gym_env, reward_bounds, reward_range
from torchrl_her_envs.common import goal_rules

from .walk import Plain


@pytest.fixture
def said(caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> pytest.LogCaptureFixture:
    monkeypatch.setattr(goal_rules, "_said", set())
    caplog.set_level(logging.INFO, "torchrl_her_envs")
    return caplog


def plain(num_envs: int = 1, **options: Any) -> GymGoalEnv:
    return make_gym_env("tests/Plain-v0", num_envs=num_envs, **options)


def steps(env: GymGoalEnv, count: int = 60) -> Any:
    torch.manual_seed(0)
    return env.rollout(count, break_when_any_done=False)["next"]


@pytest.mark.parametrize(
    ("options", "ends", "why"),
    [
        ({}, "success", r"ended where a goal was achieved, .* where info\['is_success'\] is true"),
        ({"tells": False}, "reward", "ended where .* where the reward is that of an achieved goal"),
        ({"stops": False}, "never", "it went on after a goal was achieved, so goals never end an episode"),
        ({"tells": False, "cost": 0.25}, "reward", "ended where a goal was achieved"),
        ({"tells": False, "cost": 0.25, "stops": False}, "never", "it went on after a goal was achieved"),
        (
            {"unseen": True},
            "never",
            "no goal was achieved in 200 random steps, .* choose task.options.termination=success",
        ),
        ({"unseen": True, "keeps": True}, "success", "in 200 random steps it ended where a goal was"),
        ({"unseen": True, "keeps": True, "stops": False}, "never", "it went on after a goal was achieved"),
        ({"unseen": True, "keeps": True, "tells": False}, "reward", "ended where a goal was achieved"),
        ({"unseen": True, "tells": False}, "never", "if they do, choose task.options.termination=reward"),
    ],
)
def test_what_ends_an_episode_is_found_by_trying_and_said_once(
    options: dict[str, Any], ends: str, why: str, said: pytest.LogCaptureFixture
) -> None:
    for _ in range(2):
        assert plain(**options).ends == ends
    lines = [record for record in said.records if record.levelno == logging.INFO]
    (record,) = lines  # a warning says that steps have another reward
    assert record.getMessage().startswith("tests/Plain-v0 has no compute_terminated: ")
    assert record.getMessage().endswith(f"(task.options.termination={ends})")
    assert re.search(why, record.getMessage()), record.getMessage()


@pytest.mark.parametrize("form", ["batch", "single"])
@pytest.mark.parametrize("ends", ["success", "reward", "never"])
@pytest.mark.parametrize("stops", [True, False])
def test_real_and_virtual_goals_end_by_one_rule(ends: str, stops: bool, form: str) -> None:
    """Whatever the environment itself does at a goal, and however it takes goals."""
    env = plain(4, termination=ends, stops=stops, form=form)
    assert env._reward_of.answers == ("batch" if form == "batch" else "loop")
    check_env_specs(env)
    after = steps(env)
    goals = after["achieved_goal"], after["desired_goal"]
    met = goals[0] == goals[1]
    assert met.any()
    assert torch.equal(after["terminated"], met & (ends != "never"))
    assert torch.equal(env.compute_terminated(*goals), after["terminated"])
    assert torch.equal(env.compute_reward(*goals), after["reward"])
    if ends == "never" and stops:
        assert torch.equal(after["truncated"] & met, met)  # it cannot go on there


@pytest.mark.parametrize("ends", ["success", "reward", "never", "watch"])
def test_an_end_of_another_reason_is_the_environments_own_whatever_the_rule(ends: str) -> None:
    after = steps(plain(4, falls=True, termination=ends))
    fallen = after["achieved_goal"] == 0
    assert fallen.any()
    assert after["terminated"][fallen].all()


def test_a_cost_in_the_reward_of_a_step_does_not_hide_that_its_goal_was_achieved() -> None:
    after = steps(plain(4, tells=False, stops=False, cost=0.25, termination="reward"))
    met = after["achieved_goal"] == after["desired_goal"]
    assert met.any()
    assert torch.equal(after["terminated"], met)
    assert after["reward"][met].unique().tolist() == [-0.25]


@pytest.mark.parametrize(
    ("stops", "ends", "line"),
    [
        (
            True,
            "never",
            "ended an episode where its goal was achieved, against task.options.termination=never: "
            "task.options.termination=success does as the environment",
        ),
        (
            False,
            "success",
            "went on where a goal was achieved, against task.options.termination=success: "
            "task.options.termination=never does as the environment",
        ),
        (True, "success", None),
        (False, "never", None),
    ],
)
def test_what_contradicts_the_rule_is_said_once(
    stops: bool, ends: str, line: str | None, said: pytest.LogCaptureFixture
) -> None:
    steps(plain(4, termination=ends, stops=stops))
    expected = [] if line is None else [f"tests/Plain-v0 {line}"]
    assert [record.getMessage() for record in said.records] == expected


def test_watching_leaves_the_ends_to_the_environment_and_counts_them(said: pytest.LogCaptureFixture) -> None:
    env = plain(4, falls=True, termination="watch")
    before = env.goal_ends.ended
    after = steps(env)
    met = after["achieved_goal"] == after["desired_goal"]
    assert env.ends == "watch"
    assert env.goal_ends.steps == 100 + 4 * 60
    assert env.goal_ends.ended - before == met.sum() > 0
    assert env.goal_ends.found() == "success"
    assert plain(unseen=True, termination="watch").goal_ends.found() is None
    assert not said.records


def test_a_base_class_that_has_the_mere_name_of_the_method_lacks_it() -> None:
    class Core(Plain):
        def __getattribute__(self, name: str) -> Any:
            if name == "compute_terminated":
                return self._missing
            return super().__getattribute__(name)

        def _missing(self, *goals: Any) -> Any:
            raise NotImplementedError

    gymnasium.register("tests/Core-v0", Core, max_episode_steps=6)
    assert make_gym_env("tests/Core-v0").ends == "success"


def test_what_was_asked_for_takes_the_place_of_the_method() -> None:
    env = make_gym_env("tests/Walk-v0", num_envs=4, termination="never")
    assert make_gym_env("tests/Walk-v0").ends == "own"
    assert make_gym_env("tests/Walk-v0", ends=False).ends == "never"  # its method says so of all goals
    after = steps(env)
    assert (after["reward"] == 0).any()
    assert not after["terminated"].any()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"termination": "sometimes"}, "one of auto, own, success, reward, never, watch, got 'sometimes'"),
        (
            {"termination": "success", "tells": False},
            r"task.options.termination=success needs info\['is_success'\]",
        ),
        ({"termination": "own"}, "own needs compute_terminated, .*; choose success, reward, never"),
        (
            {"dense": True},
            "Plain-v0 has a dense reward: -4, .*, -1 and other values for missed goals, 0 for equal goals",
        ),
        ({"dense": True}, "as in task.options.achieved_reward=-0.2, or choose a"),
        ({"dense": True, "achieved_reward": 1}, "must be above -4, .* at most 0, .* got 1"),
        ({"dense": True, "achieved_reward": -5}, "must be above -4, .* got -5"),
    ],
)
def test_what_cannot_be_is_said_in_one_line(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message) as raised:
        plain(**options)
    assert "\n" not in str(raised.value)


def test_with_an_achieved_reward_a_dense_reward_is_as_good_as_another() -> None:
    env = plain(2, dense=True, achieved_reward=-1.5, termination="reward")
    assert env.dense_reward
    assert (env.missed_reward, env.achieved_reward) == (-4.0, -1.5)
    assert reward_range(env) == (-4.0, -1.5)
    assert reward_bounds(env) == (-np.inf, np.inf)  # so that no target is cut off at a guess
    near = torch.tensor([[0.0], [1.0], [2.0]])
    assert env.compute_terminated(near, torch.zeros(1)).tolist() == [[True], [True], [False]]
    assert not plain().dense_reward
    assert reward_bounds(plain())[1] == 0.0


class Telling(Plain):
    """With a dense reward and the method by which Fetch and highway-env tell success."""

    def __init__(self, *, strange: bool = False) -> None:
        super().__init__(dense=True)
        self.strange = strange

    def _is_success(self, achieved: np.ndarray, desired: np.ndarray) -> bool:
        gap = abs(float((achieved - desired).item()))
        return gap < (0.5 + 0.3 * float(desired.item()) if self.strange else 1.25)


gymnasium.register("tests/Telling-v0", Telling, max_episode_steps=6)


def test_the_achieved_reward_of_a_dense_one_is_found_if_the_environment_tells_success(
    said: pytest.LogCaptureFixture,
) -> None:
    env = make_gym_env("tests/Telling-v0")
    assert env.dense_reward
    assert env.achieved_reward == pytest.approx(-1.25)
    line = "tests/Telling-v0 has a dense reward: goals count as achieved where _is_success becomes true"
    assert any(record.getMessage().startswith(line) for record in said.records)
    with pytest.raises(ValueError, match="has a dense reward"):  # success does not follow from the reward
        make_gym_env("tests/Telling-v0", strange=True)


def test_rewards_of_steps_that_goals_do_not_explain_are_noticed(said: pytest.LogCaptureFixture) -> None:
    plain(cost=0.25)
    pattern = "a step gave the reward -.*25, and compute_reward .* for the same"
    assert any(re.search(pattern, record.getMessage()) for record in said.records)


@pytest.mark.parametrize("cost", [0.0, 0.25])
def test_missed_goals_get_more_reward_the_nearer_they_are(cost: float) -> None:
    """The goal is at place 9, the walk between 0 and 4; costs of steps stay as they are."""
    env = plain(4, unseen=True, tells=False, cost=cost, shaping=[2.0, 8.0], achieved_reward=0.0)
    after = steps(env)
    away = 9 - after["achieved_goal"]
    expected = -1 + (torch.log(8 / away) / torch.log(torch.tensor(4.0))).clamp(0, 0.99)
    torch.testing.assert_close(after["reward"], expected - cost)
    torch.testing.assert_close(env.compute_reward(after["achieved_goal"], after["desired_goal"]), expected)
    goals = torch.tensor([[3.0], [4.0]])
    rewards = env.compute_reward(goals, torch.tensor([[3.0], [5.0]])).flatten().tolist()
    assert rewards == pytest.approx([0.0, -0.01])  # the second one is missed, if narrowly
    assert env.dense_reward


@pytest.mark.parametrize("shaping", [[1.0], [2.0, 1.0], [0.0, 1.0], [1.0, 2.0, 3.0], 1.0])
def test_distances_that_cannot_shape_rewards_are_refused(shaping: Any) -> None:
    with pytest.raises(ValueError, match=r"shaping must be two distances, 0 < near < far, got"):
        plain(shaping=shaping)
