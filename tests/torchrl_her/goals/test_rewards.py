"""Distances between goals, whether one is achieved, and the rewards made of that."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from torchrl_her import EnvReward, GoalReward
from torchrl_her.goals import achieved, distance


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
    with pytest.raises(ValueError, match="shorter"):
        achieved(torch.zeros(4, 2), torch.zeros(4, 1), 0.1)


def test_reward_is_0_and_terminates_where_the_goal_is_achieved() -> None:
    reward, terminated = GoalReward(0.5)(goals([0.0, 0.0], [0.0, 0.0]), goals([0.25, 0.25], [2.0, 0.0]))
    assert reward.tolist() == [[0.0], [-1.0]]
    assert terminated.tolist() == [[True], [False]]


def test_reward_has_the_type_of_the_goals() -> None:
    reward, terminated = GoalReward(0.5)(torch.zeros(3, 2, dtype=torch.float64), torch.zeros(2))
    assert (reward.dtype, terminated.dtype) == (torch.float64, torch.bool)
    assert reward.shape == terminated.shape == (3, 1)


@pytest.mark.parametrize("threshold", [0.0, -0.1, math.nan, math.inf])
def test_a_threshold_must_be_positive(threshold: float) -> None:
    with pytest.raises(ValueError, match=f"threshold must be positive and finite, got {threshold}"):
        GoalReward(threshold)


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
