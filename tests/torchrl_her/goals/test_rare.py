"""Rare goals weigh more: by hand, for any goals, after resuming, and in the writer; novel ones too."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from torchrl_her import GoalWeights
from torchrl_her.goals import NetworkNovelty, RareGoals
from torchrl_her.goals.weights import spread_evenly
from torchrl_her.trainers import load_checkpoint, save_checkpoint

from ..her_data import make_batch, make_buffer, virtual_goals

ESTIMATORS = ("kernel", "neighbors")


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def test_before_the_first_goals_all_weights_are_1() -> None:
    weights = RareGoals()
    assert weights(random(3, 2)).tolist() == [1.0, 1.0, 1.0]
    weights.update(torch.full((4, 2), math.nan))  # no goals that could be remembered
    assert weights.goals is None
    weights.update(random(500, 2))
    assert weights(torch.tensor([[0.0, 0.0], [2.0, 2.0]])).tolist() != [1.0, 1.0]
    weights.clear()
    assert weights(random(3, 2)).tolist() == [1.0, 1.0, 1.0]


def test_neighbors_by_hand() -> None:
    """In two dimensions the density is that of a disk to the neighbor: weights are squares of distances."""
    known = torch.tensor([[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0]])  # standard deviations of a half
    weights = RareGoals(estimator="neighbors", k=1)
    weights.update(known)
    asked = torch.tensor([[-1.0, 0.0], [0.0, -3.0], [1.5, 1.0]])  # 1, 3 and a half away
    assert weights(asked).tolist() == pytest.approx([1 / 9, 1.0, 0.25 / 9])
    blunt = RareGoals(estimator="neighbors", k=1, sharpness=0.5)
    blunt.update(known)
    assert blunt(asked).tolist() == pytest.approx([1 / 3, 1.0, 0.5 / 3])


def test_a_kernel_by_hand() -> None:
    weights = RareGoals(sigma=0.5)
    weights.update(
        torch.tensor([[-1.0], [-1.0], [-1.0], [1.0], [1.0], [1.0], [-1.0], [1.0]])
    )  # deviation of 1
    inside, edge = 0.5 * math.exp(-2.0) * 2, 0.5 * (1.0 + math.exp(-8.0))
    found = weights(torch.tensor([[0.0], [1.0]]))
    assert found.tolist() == pytest.approx([1.0, inside / edge])


def test_the_limit_keeps_one_goal_from_hiding_the_others() -> None:
    for estimator in ESTIMATORS:
        weights = RareGoals(estimator=estimator, limit=10.0)  # type: ignore[arg-type]
        weights.update(random(2_000, 2))
        middle, edge, far = weights(torch.tensor([[0.0, 0.0], [2.0, 2.0], [1e9, 0.0]])).tolist()
        assert far == 1.0
        assert 0.01 <= middle < 0.5 * edge


def test_beyond_three_dimensions_sharpness_falls_so_that_weights_are_cubes_of_distances() -> None:
    known = torch.cat([torch.zeros(1, 12), torch.ones(1, 12)])
    weights = RareGoals(estimator="neighbors", k=1, limit=1e6)
    weights.update(known)
    near, far = torch.zeros(12), torch.zeros(12)
    near[0], far[0] = -1.0, -2.0
    assert weights(torch.stack([near, far])).tolist() == pytest.approx([1 / 8, 1.0])


def test_numbers_of_other_units_count_alike() -> None:
    known, asked, unit = random(500, 3), random(20, 3, seed=1), torch.tensor([1.0, 5.0, 0.1])
    for estimator in ESTIMATORS:
        one, other = (RareGoals(estimator=estimator) for _ in range(2))  # type: ignore[arg-type]
        one.update(known)
        other.update(known * unit)
        torch.testing.assert_close(other(asked * unit), one(asked), rtol=1e-4, atol=1e-6)


def test_a_number_that_hardly_varies_does_not_make_goals_rare() -> None:
    known = torch.cat([random(500, 2), 0.4 + 1e-7 * random(500, 1, seed=1)], 1)
    asked = torch.cat([random(20, 2, seed=2), torch.full((20, 1), 0.4 + 1e-5)], 1)
    flat = RareGoals(sharpness=1.0)
    flat.update(known[:, :2])
    weights = RareGoals(sharpness=1.0)
    weights.update(known)
    torch.testing.assert_close(weights(asked), flat(asked[:, :2]), rtol=1e-3, atol=1e-6)


def test_the_memory_is_a_ring() -> None:
    weights = RareGoals(memory=4)
    assert weights.goals is None
    for begin, size, held in (
        (0, 3, [0, 1, 2]),
        (3, 2, [1, 2, 3, 4]),
        (5, 2, [3, 4, 5, 6]),
        (7, 8, [7, 10, 11, 14]),  # more than fit: one of every two
        (15, 1, [10, 11, 14, 15]),
        (16, 4, [16, 17, 18, 19]),
    ):
        weights.update(torch.arange(begin, begin + size).float().unsqueeze(-1))
        assert weights.goals is not None
        assert sorted(weights.goals.flatten().tolist()) == held


def test_goals_are_spread_evenly() -> None:
    assert spread_evenly(5, 10).tolist() == [0, 1, 2, 3, 4]
    assert spread_evenly(10, 5).tolist() == [0, 3, 4, 7, 8]
    assert spread_evenly(0, 5).tolist() == []


def test_goals_of_all_environments_are_looked_at() -> None:
    # Goals come environment after environment at each step; a fixed stride would meet one of them alone.
    for environments in (8, 10, 20, 64):
        seen = spread_evenly(10_000, 1_000) % environments
        assert len(seen.unique()) == environments


def test_densities_are_estimated_from_some_of_the_memory() -> None:
    known, asked = random(900, 2), random(50, 2, seed=1)
    some, few = RareGoals(samples=300), RareGoals()
    some.update(known)
    few.update(known[spread_evenly(900, 300)])
    assert torch.equal(some(asked), few(asked))


NUMBERS = st.floats(width=32) | st.floats(-3.0, 3.0, width=32)
GOALS = st.lists(st.tuples(NUMBERS, NUMBERS), max_size=15)


@pytest.mark.parametrize("kind", [*ESTIMATORS, "novel"])
@settings(max_examples=40, deadline=None)
@given(known=GOALS, asked=GOALS, sharpness=st.floats(0.01, 10.0), limit=st.floats(1.001, 1e30))
def test_weights_are_finite_and_only_goals_that_are_not_have_none(
    kind: Any,
    known: list[tuple[float, float]],
    asked: list[tuple[float, float]],
    sharpness: float,
    limit: float,
) -> None:
    weights: Any = NetworkNovelty(sharpness=sharpness, hidden=8, features=4)
    if kind != "novel":
        weights = RareGoals(estimator=kind, sharpness=sharpness, limit=limit, memory=7, samples=5, k=3)
    seen, goals = (torch.tensor(points).view(-1, 2) for points in (known, asked))
    for _ in range(2):
        weights.update(seen)
        weight = weights(goals)
        assert bool(weight.isfinite().all())
        if seen.isfinite().all(-1).any():
            finite = goals.isfinite().all(-1)
            assert torch.equal(weight > 0, finite)
            assert not finite.any() or float(weight.max()) == 1.0


def test_goals_of_another_width_are_refused() -> None:
    weights = RareGoals()
    weights.update(random(5, 2))
    with pytest.raises(ValueError, match="goals must have 2 numbers, as earlier ones, got 3"):
        weights.update(random(5, 3))
    weights.clear()
    weights.update(random(5, 3))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"estimator": "histogram"}, "estimator must be one of kernel, neighbors, got 'histogram'"),
        ({"sigma": 0.0}, "sigma must be positive and finite, got 0.0"),
        ({"sigma": [0.1, math.nan]}, "sigma must be positive and finite, got "),
        ({"sharpness": 0.0}, "sharpness must be positive and finite, or None, got 0.0"),
        ({"limit": 1.0}, "limit must be above 1 and finite, got 1.0"),
        ({"k": 0}, "k must be at least 1, got 0"),
        ({"memory": 0}, "memory must be at least 1, got 0"),
        ({"samples": 0}, "samples must be at least 1, got 0"),
    ],
)
def test_bad_options_are_named(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        RareGoals(**options)


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_it_goes_on_as_it_was_saved(estimator: Any, tmp_path: Any) -> None:
    first, second = (RareGoals(estimator=estimator, memory=50, samples=20) for _ in range(2))
    asked = random(30, 2, seed=9)
    second.update(random(7, 2))  # is forgotten
    second.load_state_dict(first.state_dict())  # of nothing
    assert second(asked).tolist() == [1.0] * 30
    for seed in range(3):
        first.update(random(30, 2, seed=seed))
    save_checkpoint({"weights": first.state_dict()}, tmp_path / "state.pt")
    second.load_state_dict(load_checkpoint(tmp_path / "state.pt")["weights"])
    for seed in range(3, 6):
        assert torch.equal(second(asked), first(asked))
        for weights in (first, second):
            weights.update(random(17, 2, seed=seed))
    with pytest.raises(ValueError, match="the state must have at most memory=10 goals, got 50"):
        RareGoals(memory=10).load_state_dict(first.state_dict())


def test_a_state_is_a_copy() -> None:
    weights = RareGoals(memory=4)
    weights.update(torch.ones(4, 1))
    state = weights.state_dict()
    weights.update(torch.zeros(2, 1))
    assert state["goals"].tolist() == [[1.0]] * 4
    other = RareGoals(memory=4)
    other.load_state_dict(state)
    other.update(torch.zeros(2, 1))
    assert state["goals"].tolist() == [[1.0]] * 4


# In the writer and when sampling


def corners(episodes: int, *, seed: int = 0) -> Any:
    """Episodes that stay at the origin but for one step in ten, which is at (1, 1)."""
    batch = make_batch([[10]] * episodes)
    path = 0.02 * random(episodes, 11, 2, seed=seed)
    path[:, 5] += 1.0
    batch["achieved_goal"], batch["next", "achieved_goal"] = path[:, :-1].clone(), path[:, 1:].clone()
    return batch


def share_of_rare(goals: Tensor) -> float:
    return float((goals[:, 0] > 0.5).float().mean())


@pytest.mark.parametrize(
    "make", [RareGoals, lambda: RareGoals(estimator="neighbors"), NetworkNovelty], ids=[*ESTIMATORS, "novel"]
)
def test_rare_goals_are_written_more_often(make: Callable[[], GoalWeights]) -> None:
    shares = []
    for weights in (None, make()):
        buffer = make_buffer(weights, strategy="episode")
        for seed in range(12):
            buffer.extend(corners(20, seed=seed))
        late = buffer[len(buffer) // 6 :]  # before, weights knew little
        shares.append(share_of_rare(virtual_goals(late)))
    assert shares[0] == pytest.approx(0.1, abs=0.02)
    assert shares[1] > 1.5 * shares[0]
