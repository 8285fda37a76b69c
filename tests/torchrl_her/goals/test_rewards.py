"""Distances between goals, whether one is achieved, and the rewards made of that."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import StepCounter, TransformedEnv

from torchrl_her import EnvReward, GoalReward
from torchrl_her.goals import achieved, distance
from torchrl_her.goals.rewards import ask_reward, missed

from ..behavior.line import Line


def goals(*rows: list[float]) -> Tensor:
    return torch.tensor(rows)


def test_distance_is_euclidean() -> None:
    assert distance(goals([0.0, 0.0], [1.0, 1.0]), goals([3.0, 4.0], [1.0, 1.0])).tolist() == [5.0, 0.0]
    assert distance(torch.tensor([1.0, 2.0, 3.0]), torch.tensor([3.0, 4.0, 4.0])).item() == 3.0


def test_a_goal_exactly_at_the_threshold_is_not_achieved() -> None:
    at, below, beyond = [0.5, 0.0], [0.4375, 0.0], [0.5625, 0.0]  # all of them exact in binary
    assert achieved(goals(at, below, beyond), torch.zeros(2), 0.5).tolist() == [False, True, False]


def test_all_coordinates_count() -> None:
    here = goals([3.0, 4.0, 0.0], [0.0, 3.0, 4.0], [1.0, 1.0, 1.0])
    assert achieved(here, torch.zeros(3), 5.0).tolist() == [False, False, True]
    assert achieved(here, torch.zeros(3), 5.001).tolist() == [True, True, True]
    assert achieved(goals([2.0]), goals([1.5]), 1.0).tolist() == [True]


def test_goals_of_different_widths_are_refused() -> None:
    with pytest.raises(ValueError, match="goals must have one width, got 2 and 1"):
        achieved(torch.zeros(4, 2), torch.zeros(4, 1), 0.1)


def test_reward_is_0_and_terminates_where_the_goal_is_achieved() -> None:
    reward, terminated = GoalReward(0.5)(goals([0.0, 0.0], [0.0, 0.0]), goals([0.25, 0.25], [2.0, 0.0]))
    assert reward.tolist() == [[0.0], [-1.0]]
    assert terminated.tolist() == [[True], [False]]


def test_an_achieved_goal_need_not_terminate() -> None:
    reward, terminated = GoalReward(0.5, terminates=False)(torch.zeros(2, 1), goals([0.25], [2.0]))
    assert reward.tolist() == [[0.0], [-1.0]]
    assert terminated.tolist() == [[False], [False]]


def test_reward_has_the_type_of_the_goals() -> None:
    reward, terminated = GoalReward(0.5)(torch.zeros(3, 2, dtype=torch.float64), torch.zeros(2))
    assert (reward.dtype, terminated.dtype) == (torch.float64, torch.bool)
    assert reward.shape == terminated.shape == (3, 1)


@pytest.mark.parametrize("threshold", [0.0, -0.1, math.nan, math.inf])
def test_a_threshold_must_be_positive(threshold: float) -> None:
    with pytest.raises(ValueError, match=f"threshold must be positive and finite, got {threshold}"):
        GoalReward(threshold)


class Paid(Line):
    """Being at the goal is worth 1, less a cost; the episode goes on there."""

    achieved_reward = 1.0
    info_keys = ("cost",)

    def compute_reward(self, achieved: Tensor, desired: Tensor, info: TensorDictBase) -> Tensor:
        return (achieved == desired).float() - info["cost"]


def test_an_environment_s_reward_is_found_below_transforms() -> None:
    rule = EnvReward.of(TransformedEnv(Paid(), StepCounter()))
    assert (rule.achieved_reward, rule.info_keys) == (1.0, ["cost"])
    info = TensorDict({"cost": torch.tensor([[0.5]])}, [1])
    assert [answer.tolist() for answer in rule(goals([1.0]), goals([1.0]), info)] == [[[0.5]], [[False]]]
    with pytest.raises(TypeError, match="must have a method compute_reward, got Line"):
        EnvReward.of(Line())


@pytest.mark.parametrize("reward", [math.nan, math.inf])
def test_the_reward_of_an_achieved_goal_must_be_finite(reward: float) -> None:
    with pytest.raises(ValueError, match=f"achieved_reward must be finite, got {reward}"):
        EnvReward(lambda got, wanted: got - wanted, achieved_reward=reward)


def test_env_reward_keeps_the_order_of_its_arguments() -> None:
    rule = EnvReward(lambda got, wanted: got - 10 * wanted, lambda got, wanted: got > wanted)
    reward, terminated = rule(goals([1.0], [5.0]), goals([2.0], [3.0]))
    assert reward.tolist() == [[-19.0], [-25.0]]  # 1 - 20 and 5 - 30
    assert terminated.tolist() == [[False], [True]]


def test_every_goal_of_an_episode_against_every_other() -> None:
    path = goals([0.0, 0.0], [0.0, 1.0], [3.0, 1.0]).unsqueeze(0)  # [E, T, g]
    reward, terminated = GoalReward(2.0)(path.unsqueeze(2), path.unsqueeze(1))
    assert reward.shape == terminated.shape == (1, 3, 3, 1)
    assert reward[0, ..., 0].tolist() == [[0.0, 0.0, -1.0], [0.0, 0.0, -1.0], [-1.0, -1.0, 0.0]]
    assert torch.equal(terminated, reward == 0)
    assert distance(path.unsqueeze(2), path.unsqueeze(1))[0, 0].tolist() == pytest.approx(
        [0, 1, math.sqrt(10)]
    )


numbers = st.floats(-4.0, 4.0, width=32)
pairs = st.integers(1, 4).flatmap(
    lambda width: st.lists(
        st.tuples(
            st.lists(numbers, min_size=width, max_size=width),
            st.lists(numbers, min_size=width, max_size=width),
        ),
        min_size=1,
        max_size=8,
    )
)


@settings(max_examples=100, deadline=None)
@given(pairs, st.floats(0.01, 8.0))
def test_a_batch_is_what_its_rows_are(rows: list[tuple[list[float], list[float]]], threshold: float) -> None:
    got, wanted = (torch.tensor([row[i] for row in rows]) for i in range(2))
    rule = GoalReward(threshold)
    reward, terminated = rule(got, wanted)
    singles = [rule(one, other) for one, other in zip(got, wanted, strict=True)]
    assert torch.equal(reward, torch.stack([single[0] for single in singles]))
    assert torch.equal(terminated, torch.stack([single[1] for single in singles]))
    assert torch.equal(terminated, rule(wanted, got)[1])
    gap = torch.tensor([math.dist(one, other) for one, other in rows], dtype=torch.float64)
    clear = (gap - threshold).abs() > 1e-5  # elsewhere rounding decides
    assert torch.equal(terminated.squeeze(-1)[clear], (gap < threshold)[clear])


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int8, torch.int64, torch.bool])
def test_whole_numbers_do_not_wrap_around(dtype: torch.dtype) -> None:
    here, there = torch.tensor([[0], [0]]).to(dtype), torch.tensor([[16], [0]]).to(dtype)
    assert achieved(here, there, 0.5).tolist() == [False, True]
    reward, terminated = GoalReward(0.5)(here, there)
    assert (reward.flatten().tolist(), terminated.flatten().tolist()) == ([-1.0, 0.0], [False, True])


def test_neighboring_numbers_stay_different_and_small_thresholds_stay_above_0() -> None:
    assert achieved(torch.tensor([2**24]), torch.tensor([2**24 + 1]), 0.5).tolist() is False
    assert achieved(torch.zeros(1).half(), torch.zeros(1).half(), 1e-4).tolist() is True


@pytest.mark.parametrize(
    ("function", "got"),
    [
        (lambda a, d: -(a - d).abs(), "Tensor; wrap a function that returns only rewards as EnvReward"),
        (lambda a, d: -(a - d).abs().numpy(), "ndarray; wrap"),
        (lambda a, d: (-(a - d).abs(), True), "Tensor and bool; wrap"),
        (lambda a, d: (a, a, a), "Tensor and Tensor and Tensor; wrap"),
        (lambda rows: rows, "takes 1 positional argument but 2 were given"),
        (lambda a, d, info: a, "missing 1 required positional argument: 'info'"),
    ],
)
@pytest.mark.parametrize("ask", [ask_reward, missed])
def test_the_form_of_a_reward_function_is_named(function: Any, got: str, ask: Any) -> None:
    form = r"must take \(achieved_goal, desired_goal\) and return \(reward, terminated\), tensors"
    with pytest.raises(ValueError, match=f"^the reward function {form} .*, got .*{got}"):
        ask(function, torch.zeros(2, 1), torch.ones(2, 1))  # two pairs, which could be unpacked


def test_an_error_within_a_reward_function_stays_what_it_is() -> None:
    with pytest.raises(TypeError, match="len"):
        ask_reward(lambda a, d: len(3), torch.zeros(2, 1), torch.ones(2, 1))  # type: ignore[arg-type]


def test_rewards_alone_are_taken_where_no_goal_ends_an_episode() -> None:
    rule = EnvReward(lambda a, d: -(a - d).abs().squeeze(-1))  # [...], as other libraries have it
    reward, terminated = ask_reward(rule, torch.zeros(2, 1), torch.tensor([[0.0], [3.0]]))
    assert reward.tolist() == [[0.0], [-3.0]]
    assert terminated.tolist() == [[False], [False]]
