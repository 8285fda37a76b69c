"""The proposal q, the weights made of q* and q, and what they do in the writer."""

from __future__ import annotations

import io
import math
import warnings
from functools import partial
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from torchrl_her import GoalGrid, Instructiveness, box_target
from torchrl_her.goals import GoalHistogram, kl_divergence
from torchrl_her.goals.ibs import HistogramsOfRuns
from torchrl_her.goals.weights import WeightsOfRuns

from ..goal_grids import LINE, RIGHT, SCREEN
from ..her_data import make_batch, make_buffer, virtual_goals

HALVES = GoalGrid(0.0, 1.0, [2])


LEFT_AND_RIGHT = torch.tensor([[0.1], [0.9]])


def quarters(sigma: float) -> Tensor:
    return torch.tensor([0.25, 0.75])


def written(*cells: int) -> Tensor:
    """Goals [n, 1] in these halves."""
    return torch.tensor(cells).unsqueeze(-1) * 0.5 + 0.25


def through_a_file(state: dict[str, Any]) -> dict[str, Any]:
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    return torch.load(file, weights_only=True)


# The histogram


def test_histogram_counts_and_weighs_all_alike() -> None:
    histogram = GoalHistogram(HALVES)
    assert histogram.q.tolist() == [0.0, 0.0]
    assert math.isnan(histogram.divergence_to(quarters(0.1)))  # there is no q yet
    histogram.update(written(0, 0))
    histogram.update(written(0, 1))
    assert histogram.counts.tolist() == [3, 1]
    assert histogram.q.tolist() == [0.75, 0.25]
    assert histogram(LEFT_AND_RIGHT).tolist() == [1.0, 1.0]
    by_hand = 0.75 * math.log(3) - 0.25 * math.log(3)
    assert histogram.divergence_to(quarters(0.1)) == pytest.approx(by_hand)
    histogram.update(torch.empty(0, 1))
    assert histogram.counts.tolist() == [3, 1]
    histogram.clear()
    assert histogram.q.tolist() == [0.0, 0.0]


def test_histogram_state_is_its_own_copy() -> None:
    first, second = GoalHistogram(HALVES), GoalHistogram(HALVES)
    first.update(written(0, 1, 1))
    state = through_a_file(first.state_dict())
    second.load_state_dict(state)
    first.update(written(0))
    state["counts"].zero_()
    first.state_dict()["counts"].zero_()
    assert (first.counts.tolist(), second.counts.tolist()) == ([2, 2], [1, 2])


def test_a_state_of_another_grid_is_refused() -> None:
    with pytest.raises(ValueError, match="the grid has 2 cells, the state 3"):
        GoalHistogram(HALVES).load_state_dict(GoalHistogram(LINE).state_dict())


# The weights


def test_weights_by_hand() -> None:
    weights = Instructiveness(HALVES, quarters, sigma=0.1, floor=0.01)
    assert weights(LEFT_AND_RIGHT).tolist() == [0.25, 0.75]  # before the first write, q* alone
    weights.update(written(0, 1, 1, 1, 1))
    assert weights(LEFT_AND_RIGHT).tolist() == pytest.approx(
        [0.05, 0.0075]
    )  # q = (0.2, 0.8): below the floor
    weights.clear()
    assert weights(LEFT_AND_RIGHT).tolist() == [0.25, 0.75]


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({}, 0.002 * 0.75),
        ({"floor": 0.02}, 0.02 * 0.75),
        ({"floor": 0.02, "floor_is_relative": False}, 0.02),
        ({"floor": 0.0}, 0.0),
    ],
)
def test_floor_is_relative_to_the_largest_target_or_absolute(
    options: dict[str, Any], expected: float
) -> None:
    weights = Instructiveness(HALVES, quarters, sigma=0.1, **options)
    weights.update(written(0))
    assert weights(LEFT_AND_RIGHT).tolist() == pytest.approx([expected, 0.75])


def test_the_sequential_architecture_weighs_by_the_target_alone() -> None:
    weights = Instructiveness(HALVES, quarters, sigma=0.1, subtract=False, floor=0.5)
    weights.update(written(0, 0, 0))
    assert weights(LEFT_AND_RIGHT).tolist() == [0.25, 0.75]
    assert weights.q.tolist() == [1.0, 0.0]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_weights_have_the_shape_and_type_of_goals(dtype: torch.dtype) -> None:
    weights = Instructiveness(SCREEN, RIGHT, sigma=0.2)
    goals = torch.rand(3, 5, 2, dtype=dtype, generator=torch.Generator().manual_seed(0))
    assert weights(goals).dtype == dtype
    assert weights(goals).shape == (3, 5)
    assert torch.equal(weights(goals), weights.q_star.to(dtype)[SCREEN.cell(goals)])
    assert weights(goals[:, :0]).shape == (3, 0)


def test_a_tiny_sigma_still_leaves_all_goals_a_chance() -> None:
    weights = Instructiveness(SCREEN, RIGHT, sigma=1e-9, start_factor=1.0)
    assert (weights.q_star == 0).float().mean() > 0.7
    goals = SCREEN.centers.float()
    assert (weights(goals) > 0).all()
    weights.update(goals)
    assert (weights(goals) > 0).all()
    assert weights.divergence == math.inf  # goals where q* is 0


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.tuples(*[st.floats(allow_nan=False, allow_infinity=False, width=32)] * 2), max_size=30),
    st.floats(1e-6, 5.0),
    st.floats(0.0, 1.0),
    st.booleans(),
    st.booleans(),
)
def test_weights_are_never_negative_nor_nan(
    points: list[tuple[float, float]], sigma: float, floor: float, relative: bool, subtract: bool
) -> None:
    """Goals of any finite value."""
    grid = GoalGrid((0.0, 0.0), (1.0, 1.0), (4, 5))
    target = partial(box_target, grid, (0.6, 0.1), (0.9, 0.8))
    options = {"floor": floor, "floor_is_relative": relative, "subtract": subtract}
    weights = Instructiveness(grid, target, sigma=sigma, **options)  # type: ignore[arg-type]
    goals = torch.tensor(points).view(-1, 2)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for _ in range(2):
            weight = weights(goals)
            assert (weight >= 0).all()
            if floor > 1e-30 and subtract:  # below that, float32 has no such number
                assert (weight > 0).all()
            weights.update(goals)
            weights.step()
    assert weights.counts.sum() == 2 * len(points)
    assert float(weights.q.sum()) == pytest.approx(1.0 if points else 0.0)
    assert math.isnan(weights.divergence) != bool(points)


def test_schedule_by_hand() -> None:
    weights = Instructiveness(SCREEN, RIGHT, sigma=0.2)
    sigmas = [weights.sigma]
    for _ in range(25):
        weights.step()
        sigmas.append(weights.sigma)
    # The covariance falls from 0.36 by 0.9 each time: 0.9^20 is above 1/9, 0.9^21 below
    assert [s**2 for s in sigmas[:4]] == pytest.approx([0.36, 0.324, 0.2916, 0.26244])
    assert sigmas[20] > 0.2
    assert sigmas[21:] == [0.2] * 5
    assert torch.equal(weights.q_star, RIGHT(0.2))
    weights.restart()
    assert weights.sigma == pytest.approx(0.6)
    assert torch.equal(weights.q_star, RIGHT(weights.sigma))
    assert torch.equal(weights.final_q_star, RIGHT(0.2))


def test_emptying_forgets_q_and_keeps_sigma_and_restarting_the_reverse() -> None:
    weights = Instructiveness(HALVES, quarters, sigma=0.1)
    weights.step()
    weights.update(written(1))
    sigma = weights.sigma
    weights.clear()
    assert (weights.sigma, weights.q.tolist()) == (sigma, [0.0, 0.0])
    weights.update(written(1))
    weights.restart()
    assert weights.sigma == pytest.approx(0.3)
    assert weights.q.tolist() == [0.0, 1.0]


def test_no_shrinking_with_a_decay_of_one() -> None:
    weights = Instructiveness(HALVES, quarters, sigma=0.1, decay=1.0, start_factor=2.0)
    weights.step()
    assert weights.sigma == 0.2


def test_divergence_is_against_the_final_sigma() -> None:
    weights = Instructiveness(SCREEN, RIGHT, sigma=0.2)
    assert math.isnan(weights.divergence)
    weights.update(torch.tensor([[0.75, 0.5], [0.75, 0.5], [0.05, 0.05]]))
    final, now = (float(kl_divergence(weights.q, RIGHT(s))) for s in (0.2, weights.sigma))
    assert weights.divergence == pytest.approx(final)
    assert final != pytest.approx(now)
    weights.step()
    assert weights.divergence == pytest.approx(final)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sigma": 0.0}, "sigma must be positive and finite, got 0.0"),
        ({"sigma": -1.0}, "sigma must be positive and finite, got -1.0"),
        ({"sigma": math.nan}, "sigma must be positive and finite, got nan"),
        ({"start_factor": 0.5}, "start_factor must be at least 1 and finite, got 0.5"),
        ({"decay": 0.0}, "decay must be above 0 and at most 1, got 0.0"),
        ({"decay": 1.5}, "decay must be above 0 and at most 1, got 1.5"),
        ({"floor": -0.1}, "floor must be at least 0 and finite, got -0.1"),
    ],
)
def test_bad_options_are_named(options: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Instructiveness(HALVES, quarters, **{"sigma": 0.2, **options})


@pytest.mark.parametrize(
    "q_star", [[1.0], [[0.5, 0.5]], [1.5, -0.5], [math.nan, 0.5], [3.0, 5.0], [0.0, 0.0]]
)
def test_targets_that_are_no_distribution_over_the_grid_are_refused(q_star: Any) -> None:
    with pytest.raises(ValueError, match="the target must give 2 numbers of at least 0 that sum to 1"):
        Instructiveness(HALVES, lambda sigma: torch.tensor(q_star), sigma=0.2)


# In the writer


def scattered(episodes: int, length: int = 20, *, seed: int = 0) -> Any:
    """Episodes that achieve goals anywhere on the screen, more often at its left."""
    batch = make_batch([[length]] * episodes)
    path = torch.rand(episodes, length + 1, 2, generator=torch.Generator().manual_seed(seed))
    path[..., 0].square_()
    batch["achieved_goal"], batch["next", "achieved_goal"] = path[:, :-1].clone(), path[:, 1:].clone()
    return batch


def test_ibs_writes_goals_nearer_to_the_target_than_her() -> None:
    her, sequential = GoalHistogram(SCREEN), Instructiveness(SCREEN, RIGHT, sigma=0.2, subtract=False)
    ibs = Instructiveness(SCREEN, RIGHT, sigma=0.2)
    share = []
    for weights in (her, sequential, ibs):
        buffer = make_buffer(weights)
        for epoch in range(10):
            buffer.extend(scattered(100, seed=epoch))
            if isinstance(weights, Instructiveness):
                weights.step()
        goals = virtual_goals(buffer[:])
        assert torch.equal(weights.counts, SCREEN.cell(goals).bincount(minlength=400))
        inside = ((goals > torch.tensor([0.55, 0.2])) & (goals < torch.tensor([0.95, 0.8]))).all(-1)
        share.append(float(inside.float().mean()))
    assert share[0] < share[1] < share[2]
    assert ibs.divergence < sequential.divergence < her.divergence_to(RIGHT(0.2))
    assert ibs.divergence < 0.5 * her.divergence_to(RIGHT(0.2))


# Several runs at once


class Twice(Instructiveness):
    """A subclass, of which nothing is known."""

    def __call__(self, goals: Tensor) -> Tensor:
        return 2 * super().__call__(goals)


@pytest.mark.parametrize("kind", [GoalHistogram, Instructiveness, Twice])
def test_runs_are_looked_up_and_counted_as_each_would_be_alone(kind: type[GoalHistogram]) -> None:
    def make() -> list[Any]:
        if kind is GoalHistogram:
            return [GoalHistogram(LINE) for _ in range(3)]
        target = partial(box_target, LINE, 0.2, 0.9)
        return [
            kind(LINE, target, sigma=0.1 + 0.1 * run, floor=0.01 * run, subtract=run != 2)  # type: ignore[call-arg]
            for run in range(3)
        ]

    joint, alone = make(), make()
    together = joint[0].of_runs(joint)
    assert type(together) is (WeightsOfRuns if kind is Twice else HistogramsOfRuns)
    generator = torch.Generator().manual_seed(0)
    for runs, counts in (([0, 1, 2], [5, 0, 7]), ([0, 2], [3, 4]), ([1], [6])):
        goals = torch.rand(sum(counts), 4, 1, generator=generator)
        expected = [alone[run](own) for run, own in zip(runs, goals.split(counts), strict=True)]
        assert torch.equal(together(goals, runs, counts), torch.cat(expected))
        together.update(goals[:, 0], runs, counts)
        for run, own in zip(runs, goals[:, 0].split(counts), strict=True):
            alone[run].update(own)
    for own, single in zip(joint, alone, strict=True):
        assert torch.equal(own.counts, single.counts)
    assert [int(own.counts.sum()) for own in joint] == [8, 6, 11]


def test_runs_over_different_grids_are_asked_one_by_one() -> None:
    own = [GoalHistogram(HALVES), GoalHistogram(GoalGrid(0.0, 1.0, [4]))]
    together = own[0].of_runs(own)
    assert type(together) is WeightsOfRuns
    together.update(torch.tensor([[0.1], [0.9], [0.9]]), [0, 1], [1, 2])
    assert [weights.counts.tolist() for weights in own] == [[1, 0], [0, 0, 0, 2]]


@pytest.mark.parametrize("together", [False, True])
def test_only_the_newest_goals_count(together: bool) -> None:
    grid = GoalGrid(0.0, 3.0, [3])
    first, second = GoalHistogram(grid, recent=4), GoalHistogram(grid, recent=4)
    for goals in ([0.5, 0.5, 1.5], [2.5, 2.5, 2.5], [1.5] * 9):
        both = torch.tensor(goals).unsqueeze(-1)
        if together:
            first.of_runs([first, second]).update(torch.cat((both, both[:1])), [0, 1], [len(goals), 1])
        else:
            first.update(both)
        if goals[0] == 2.5:
            assert first.counts.tolist() == [0, 1, 3]
    assert first.counts.tolist() == [0, 4, 0]
    assert second.counts.tolist() == ([1, 1, 1] if together else [0, 0, 0])
    other = GoalHistogram(grid, recent=4)
    other.load_state_dict(first.state_dict())
    for own in (first, other):
        own.update(torch.tensor([[0.5], [2.5]]))
        assert own.counts.tolist() == [1, 2, 1]
    first.clear()
    first.update(torch.tensor([[0.5]]))
    assert first.counts.tolist() == [1, 0, 0]


def test_recent_must_be_positive() -> None:
    with pytest.raises(ValueError, match="recent must be at least 1, got 0"):
        GoalHistogram(GoalGrid(0.0, 3.0, [3]), recent=0)
