"""Drawing the virtual goals of whole episodes, with each factor alone and all together."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from torchrl_her import GoalWeights
from torchrl_her.replay_buffers import Episodes, draw_goals

WALK = torch.arange(6.0).unsqueeze(-1)  # two episodes: 0 to 3 and 3 to 5; then they have 3 and 2 steps
EPISODES = Episodes(rows=torch.tensor([[0, 1, 2], [3, 4, 4]]), lengths=torch.tensor([3, 2]))


class ByGoal(GoalWeights):
    """The weight of a goal is what a table says."""

    def __init__(self, *table: float) -> None:
        self.table = torch.tensor(table)

    def __call__(self, goals: Tensor) -> Tensor:
        return self.table[goals.squeeze(-1).long()]


def drawn(k: int = 2_000, **options: object) -> dict[int, dict[int, float]]:
    """For each transition, how often each other one gave the goal."""
    generator = torch.Generator().manual_seed(0)
    source, goal = draw_goals(WALK[:-1], WALK[1:], EPISODES, k, generator=generator, **options)  # type: ignore[arg-type]
    shares: dict[int, dict[int, float]] = {}
    for row in source.unique().tolist():
        goals, counts = goal[source == row].unique(return_counts=True)
        shares[row] = dict(zip(goals.tolist(), (counts / k).tolist(), strict=True))
    return shares


@pytest.mark.parametrize(
    ("strategy", "expected"),
    [
        ("future", [{0, 1, 2}, {1, 2}, {2}, {3, 4}, {4}]),
        ("final", [{2}, {2}, {2}, {4}, {4}]),
        ("episode", [{0, 1, 2}, {0, 1, 2}, {0, 1, 2}, {3, 4}, {3, 4}]),
        (lambda time, lengths: (time, time + 1), [{0}, {1}, {2}, {3}, {4}]),
    ],
)
def test_the_strategy_alone(strategy: object, expected: list[set[int]]) -> None:
    shares = drawn(strategy=strategy)
    assert [set(shares[row]) for row in range(5)] == expected
    for own in shares.values():
        assert all(share == pytest.approx(1 / len(own), abs=0.06) for share in own.values())  # five sigma


def test_weights_multiply_with_the_strategy() -> None:
    shares = drawn(weights=ByGoal(0.0, 1.0, 3.0, 0.0, 1.0, 0.0))  # transition i achieves the goal i + 1
    assert shares[0] == pytest.approx({0: 0.25, 1: 0.75}, abs=0.05)
    assert shares[1] == {1: 1.0}
    assert shares[3] == {3: 1.0}
    assert set(shares) == {0, 1, 3}  # the others have no goal of a weight above 0


def test_the_filter_multiplies_with_both() -> None:
    def far(before: Tensor, goals: Tensor) -> Tensor:
        return (goals - before).squeeze(-1) > 1.5

    assert set(drawn(keep=far)) == {0, 1, 3}
    assert drawn(keep=far)[0] == pytest.approx({1: 0.5, 2: 0.5}, abs=0.06)
    weighted = drawn(keep=far, weights=ByGoal(0.0, 9.0, 1.0, 3.0, 1.0, 0.0))
    assert weighted[0] == pytest.approx({1: 0.25, 2: 0.75}, abs=0.05)
    assert set(weighted) == {0, 1}


def test_each_transition_is_given_k_goals_in_a_row() -> None:
    source, goal = draw_goals(WALK[:-1], WALK[1:], EPISODES, 3)
    assert source.tolist() == [row for row in range(5) for _ in range(3)]
    assert goal.shape == source.shape


def test_no_draws_ask_for_nothing() -> None:
    source, goal = draw_goals(WALK[:-1], WALK[1:], EPISODES, 0)
    assert source.tolist() == goal.tolist() == []
