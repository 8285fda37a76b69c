"""What is measured of rollouts, by hand; and that only the first episode of each environment counts."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import Tensor

from torchrl_her import GoalReward, success
from torchrl_her.trainers import discounted_return, final_distance, first_episode, q_bias, reached

# How a step ends: "-" goes on, "T" terminates, "U" truncates, "B" does both.
ENDS = "-TUB"


def rollout(*worlds: str, rewards: list[list[float]] | None = None) -> TensorDict:
    """A rollout [N, T]; a reward is 0 where a step terminates and -1 elsewhere, if not given."""
    terminated, truncated = (
        torch.tensor([[end in kind for end in ends] for ends in worlds]).unsqueeze(-1)
        for kind in ("TB", "UB")
    )
    reward = terminated.float() - 1.0 if rewards is None else torch.tensor(rewards).unsqueeze(-1)
    done = terminated | truncated
    flags = {"terminated": terminated, "truncated": truncated, "done": done, "reward": reward}
    return TensorDict({"next": flags}, batch_size=done.shape[:2])


@pytest.mark.parametrize(
    ("done", "inside"),
    [([0, 0, 0], [1, 1, 1]), ([1, 0, 0], [1, 0, 0]), ([0, 0, 1], [1, 1, 1]), ([0, 1, 1], [1, 1, 0])],
)
def test_the_first_episode_ends_at_its_first_done(done: list[int], inside: list[int]) -> None:
    assert first_episode(torch.tensor(done).bool()).int().tolist() == inside


@pytest.mark.parametrize("measure", [success, reached])
def test_where_goals_end_episodes_success_is_to_have_reached_one(measure: Callable[..., Tensor]) -> None:
    assert measure(rollout("---U", "---T", "T---", "---B")).tolist() == [False, True, True, True]


def test_a_goal_that_was_left_again_was_reached_without_success() -> None:
    left = rollout("--U", "--U", rewards=[[-1.0, 0.0, -1.0], [-1.0, -1.0, 0.0]])
    assert reached(left).tolist() == [True, True]
    assert success(left).tolist() == [False, True]


def test_a_cost_of_actions_does_not_hide_success() -> None:
    data = rollout("--U", "--U", rewards=[[-1.01, -1.01, -0.01], [-1.01, -0.01, -1.01]])
    data["next", "achieved_goal"] = torch.tensor([[[3.0], [2.0], [1.0]], [[3.0], [1.0], [2.0]]])
    data["next", "desired_goal"] = torch.ones(2, 3, 1)
    assert success(data).tolist() == [False, False]  # by the step's reward
    assert success(data, GoalReward(0.1)).tolist() == [True, False]
    assert reached(data, GoalReward(0.1)).tolist() == [True, True]


def test_the_environments_own_word_comes_first() -> None:
    data = rollout("--U", "--U", rewards=[[-1.0, -1.0, -1.0], [0.0, 0.0, 0.0]])
    data["next", "is_success"] = torch.tensor([[0, 0, 1], [1, 1, 0]]).bool().unsqueeze(-1)
    assert success(data).tolist() == [True, False]
    assert reached(data).tolist() == [True, True]


def test_success_after_a_reset_does_not_count() -> None:
    assert success(rollout("-UT-", "-U-T", "UTTT")).tolist() == [False, False, False]


def test_another_reward_may_mean_success() -> None:
    goals = {"achieved_goal": torch.tensor([[[0.0]], [[9.0]]]), "desired_goal": torch.zeros(2, 1, 1)}
    ended = TensorDict({"next": {**goals, "done": torch.ones(2, 1, 1).bool()}}, [2, 1])
    rule = GoalReward(0.5, missed_reward=0.0, achieved_reward=1.0)
    assert success(ended, rule).tolist() == reached(ended, rule).tolist() == [True, False]


def test_final_distance_is_that_of_the_first_episodes_last_step() -> None:
    data = rollout("--U-", "----", "T---")
    path = torch.tensor([[3.0, 0.0], [6.0, 0.0], [9.0, 0.0], [12.0, 0.0]])
    data["next", "achieved_goal"] = path.expand(3, 4, 2)
    data["next", "desired_goal"] = torch.tensor([0.0, 4.0]).expand(3, 4, 2)
    expected = [97**0.5, 160**0.5, 5.0]  # (9, -4), (12, -4), (3, -4)
    assert final_distance(data).tolist() == pytest.approx(expected)


def test_discounted_return_of_other_rewards() -> None:
    data = rollout("--U-", "--T-", rewards=[[1.0, 2.0, 3.0, 100.0]] * 2)
    got = discounted_return(data, 0.1, tail_reward=9.0)
    assert got.tolist() == pytest.approx([1.23 + 0.01, 1.23])  # 9 * (0.001 + 0.0001 + ...) = 0.01


def step_by_step(ends: str, gamma: float) -> float:
    total, discount = 0.0, 1.0
    for end in ends:
        total += discount * (0.0 if end in "TB" else -1.0)
        discount *= gamma
        if end != "-":
            break
    if end not in "TB":
        for _ in range(500):
            total -= discount
            discount *= gamma
    return total


@settings(max_examples=100, deadline=None)
@given(
    st.lists(st.text(ENDS, min_size=5, max_size=5), min_size=1, max_size=6), st.sampled_from([0.0, 0.5, 0.9])
)
def test_discounted_return_is_the_sum_step_by_step(worlds: list[str], gamma: float) -> None:
    expected = [step_by_step(ends, gamma) for ends in worlds]
    assert discounted_return(rollout(*worlds), gamma).tolist() == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("value", [torch.tensor([-1.0, -3.0]), torch.tensor([[-1.0], [-3.0]])])
def test_bias_is_what_was_expected_minus_what_was_got(value: Tensor) -> None:
    assert q_bias(value, torch.tensor([-2.0, -2.0])).tolist() == [1.0, -1.0]
