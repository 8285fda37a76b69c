"""Drawing the virtual goals of whole episodes, with each factor alone and all together."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_her import GoalReward, GoalWeights, HindsightOptions
from torchrl_her.goals.weights import WeightsOfRuns
from torchrl_her.replay_buffers import Episodes, draw_goals
from torchrl_her.replay_buffers.draw import draw_for_runs
from torchrl_her.replay_buffers.runs.pieces import Chunk, Piece
from torchrl_her.replay_buffers.runs.recent import RecentGoals

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


def test_each_run_draws_with_its_own_weights_and_filter() -> None:
    """Run 2 takes any goal, run 5 only the goal 5. The filter refuses goals within 1.5 of a state."""
    piece = Piece([2, 5], EPISODES, torch.tensor([0, 1]))
    rows = TensorDict({"achieved_goal": WALK[:-1], "next": {"achieved_goal": WALK[1:]}}, [5])
    never = ByGoal(*[0.0] * 6)
    weights = WeightsOfRuns([never, never, ByGoal(0, 1, 1, 1, 1, 1), never, never, ByGoal(0, 0, 0, 0, 0, 1)])

    def draw(*generators: torch.Generator, k: int = 3, **changes: object) -> tuple[list[int], list[int]]:
        options = HindsightOptions(k=k, filter_achieved=True).changed(changes)
        chunk = Chunk(rows, None, piece, GoalReward(1.5), options, options.transition_keys())
        source, goals, _ = draw_for_runs(
            chunk, weights=weights, generators=generators, recent=RecentGoals.none(6)
        )
        return source.tolist(), [int(goal) - 1 for goal in goals]  # goal i + 1 was achieved by transition i

    seeded = [torch.Generator().manual_seed(seed) for seed in (0, 1)]
    source, goal = draw(*seeded)
    # From state 0, goals 2 and 3 are far enough; from 1, goal 3; from 3, goal 5. By 1, 2 and 4.
    assert source == [0, 0, 0, 1, 1, 1, 3, 3, 3]
    assert set(goal[:3]) <= {1, 2}
    assert goal[3:] == [2, 2, 2, 4, 4, 4]
    assert draw(*seeded, k=0) == ([], [])
    assert draw(*seeded, strategy="final")[1] == [2, 2, 2, 2, 2, 2, 4, 4, 4]
