"""The grid, the target q*, the proposal q, and the weights made of them."""

from __future__ import annotations

import io
import math
import warnings
from functools import partial, reduce
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from torchrl_her import (
    GoalGrid,
    GoalHistogram,
    GoalReward,
    GoalWeights,
    HERWriter,
    Instructiveness,
    box_target,
    kl_divergence,
    sampled_target,
)

from .her_data import make_batch

LINE = GoalGrid(0.0, 3.0, [3])  # centres at 0.5, 1.5 and 2.5
SCREEN = GoalGrid((0.0, 0.0), (1.0, 1.0), (20, 20))
RIGHT = partial(box_target, SCREEN, (0.55, 0.2), (0.95, 0.8))
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


# The grid


def test_cells_by_hand() -> None:
    grid = GoalGrid((0.0, -1.0, 10.0), (2.0, 1.0, 40.0), (2, 4, 3))
    goals = torch.tensor([[0.5, -0.9, 12.0], [0.5, -0.9, 25.0], [0.5, -0.1, 12.0], [1.5, 0.9, 39.0]])
    assert grid.num_cells == 24
    assert grid.cell(goals).tolist() == [0, 1, 3, 23]
    assert grid.cell(goals.double().view(2, 2, 3)).tolist() == [[0, 1], [3, 23]]
    assert grid.centres[23].tolist() == [1.5, 0.75, 35.0]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_every_centre_lies_in_its_own_cell(dtype: torch.dtype) -> None:
    grid = GoalGrid((-1.0, 0.3, 5.0), (1.0, 0.4, 500.0), (7, 20, 3))
    assert torch.equal(grid.cell(grid.centres.to(dtype)), torch.arange(420))


def test_the_edges_of_the_box_belong_to_the_cells_at_the_edge() -> None:
    corners = torch.tensor([[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0], [1.0 + 1e-6, -1e-6]])
    assert SCREEN.cell(corners).tolist() == [0, 19, 380, 399, 380]  # no warning for what was rounded


def test_goals_outside_count_at_the_edge_and_are_named_once() -> None:
    grid = GoalGrid((0.0, 0.0), (1.0, 1.0), (2, 2))
    goals = torch.tensor([[0.1, 0.1], [0.25, 7.5], [-3e38, math.inf], [math.inf, -math.inf]])
    with pytest.warns(
        UserWarning, match=r"goal \[0.25, 7.5\] lies outside.*low=\(0.0, 0.0\), high=\(1.0, 1.0\)"
    ):
        assert grid.cell(goals).tolist() == [0, 1, 1, 2]
    assert grid.cell(goals).tolist() == [0, 1, 1, 2]  # warnings are errors here: it is said once
    with pytest.warns(UserWarning, match="lies outside"):  # once for each grid
        GoalGrid(0.0, 1.0, [2]).cell(torch.tensor([[2.0]]))


def test_nan_is_named_and_counted_in_the_first_cell() -> None:
    grid = GoalGrid((0.0, 0.0), (1.0, 1.0), (2, 2))
    with pytest.warns(UserWarning, match=r"goal \[0.75, nan\] lies outside"):
        assert grid.cell(torch.tensor([[0.1, 0.1], [0.75, math.nan]])).tolist() == [0, 2]


def test_no_goals_have_no_cells() -> None:
    assert SCREEN.cell(torch.empty(0, 2)).tolist() == []
    assert SCREEN.cell(torch.empty(3, 0, 2)).shape == (3, 0)


@pytest.mark.parametrize(
    ("low", "high", "shape", "message"),
    [
        ((0.0, 1.0), (1.0, 1.0), (2, 2), r"low < high.*got low=\(0.0, 1.0\), high=\(1.0, 1.0\)"),
        ((2.0,), (1.0,), (2,), r"low < high.*got low=\(2.0,\), high=\(1.0,\)"),
        ((0.0,), (math.inf,), (2,), "both finite.*inf"),
        ((math.nan,), (1.0,), (2,), "low < high.*nan"),
        ((0.0, 0.0), (1.0,), (2, 2), r"one number for each dimension.*high=\(1.0,\)"),
        ((0.0,), (1.0,), (2, 2), r"one number for each dimension.*shape=\(2, 2\)"),
        ((), (), (), r"one number for each dimension"),
        ((0.0, 0.0), (1.0, 1.0), (2, 0), r"at least 1 in each dimension, got \(2, 0\)"),
        ((0.0, 0.0), (1.0, 1.0), (-2, -2), r"at least 1 in each dimension, got \(-2, -2\)"),
        ((0.0, 0.0), (1.0, 1.0), (4096, 4097), "at most 16777216 cells, got 16781312"),
    ],
)
def test_bad_grids_are_named(low: Any, high: Any, shape: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        GoalGrid(low, high, shape)


def test_goals_of_other_dimensions_are_refused() -> None:
    with pytest.raises(ValueError, match="grid has 2 dimensions, got goals of 3"):
        SCREEN.cell(torch.zeros(4, 3))


# The target


def test_target_by_hand() -> None:
    # From a table of the normal distribution: 0.5 to 1.5 seen from 0.5, 1.5 and 2.5 in units of sigma
    within_one, one_to_two = 0.341344746068543, 0.135905121983278
    total = 2 * within_one + one_to_two
    expected = [within_one / total, within_one / total, one_to_two / total]
    assert box_target(LINE, 0.5, 1.5, 1.0).tolist() == pytest.approx(expected, rel=1e-12)


def simpson(low: float, high: float, n: int) -> tuple[Tensor, Tensor]:
    """Points and weights of the integral over [low, high]; n is even."""
    weight = torch.ones(n + 1, dtype=torch.float64)
    weight[1:-1:2], weight[2:-1:2] = 4.0, 2.0
    return torch.linspace(low, high, n + 1, dtype=torch.float64), weight * (high - low) / n / 3


@pytest.mark.parametrize(
    ("grid", "low", "high", "sigma", "n"),
    [
        (GoalGrid(-1.0, 1.0, [30]), [0.55], [0.95], [0.2], 2000),
        (GoalGrid(-1.0, 1.0, [30]), [0.9], [1.3], [0.1], 20_000),  # seen from 19 sigma away
        (GoalGrid(0.0, 1.0, [20]), [0.5], [0.5 + 1e-6], [0.2], 20),  # thin
        (GoalGrid(0.0, 1.0, [20]), [0.2], [0.8], [1e4], 200),
        (GoalGrid((0.0, 0.0), (1.0, 1.0), (8, 6)), [0.55, 0.2], [0.95, 0.8], [0.2, 0.2], 200),
        (GoalGrid((0.0, 0.0), (1.0, 2.0), (8, 6)), [0.55, -0.2], [0.95, 0.8], [0.1, 0.3], 300),
        (GoalGrid((0.0,) * 3, (1.0, 1.0, 2.0), (4, 3, 2)), [0.5, 0.2, 0.3], [0.9, 0.8, 0.9], [0.4] * 3, 60),
    ],
)
def test_target_against_numerical_integration(
    grid: GoalGrid, low: list[float], high: list[float], sigma: list[float], n: int
) -> None:
    rules = [simpson(a, b, n) for a, b in zip(low, high, strict=True)]
    points = torch.cartesian_prod(*(point for point, _ in rules)).view(-1, len(low))
    weight = reduce(torch.mul, torch.meshgrid(*(weight for _, weight in rules), indexing="ij")).flatten()
    unit = torch.tensor(sigma, dtype=torch.float64)
    squares = [((points - centre) / unit).square().sum(-1) for centre in grid.centres]
    mu = torch.stack([((-square / 2).exp() * weight).sum() for square in squares])
    expected = mu / mu.sum()
    error = (box_target(grid, low, high, sigma) / expected - 1).abs().max()
    assert error < 1e-6


def test_one_sigma_stands_for_all_dimensions() -> None:
    assert torch.equal(RIGHT(0.2), RIGHT((0.2, 0.2)))
    assert not torch.equal(RIGHT(0.2), RIGHT((0.2, 0.1)))


def test_far_tails_keep_their_digits() -> None:
    # 31 and 30 sigma away: Q(30) / Q(31) from the asymptotic series Q(x) = phi(x) / x (1 - 1 / x^2 + ...)
    q = box_target(GoalGrid(-0.5, 1.5, [2]), 31.0, 1e3, 1.0)  # centres at 0 and 1

    def tail(x: float) -> float:
        return sum(t / x ** (2 * i + 1) for i, t in enumerate((1, -1, 3, -15, 105, -945)))

    assert float(q[1] / q[0]) == pytest.approx(math.exp(30.5) * tail(30.0) / tail(31.0), rel=1e-7)


@pytest.mark.parametrize("sigma", [1e-5, 1e-30, 1e-300, 5e-324])
def test_a_tiny_sigma_leaves_the_cells_in_the_box_or_the_nearest_one(sigma: float) -> None:
    assert box_target(LINE, 0.0, 2.0, sigma).tolist() == [0.5, 0.5, 0.0]
    assert box_target(LINE, 0.6, 0.9, sigma).tolist() == [1.0, 0.0, 0.0]  # between centres
    assert box_target(LINE, 50.0, 60.0, sigma).tolist() == [0.0, 0.0, 1.0]


@pytest.mark.parametrize("sigma", [1e9, 1e308])
def test_a_huge_sigma_is_uniform(sigma: float) -> None:
    assert RIGHT(sigma).tolist() == pytest.approx([1 / 400] * 400)
    assert box_target(LINE, 0.0, 1e-320, sigma).tolist() == pytest.approx([1 / 3] * 3)


def test_samples_converge_to_the_closed_form() -> None:
    generator = torch.Generator().manual_seed(0)
    grid = GoalGrid((0.0, 0.0), (1.0, 1.0), (5, 4))
    u = torch.rand(40_000, 2, dtype=torch.float64, generator=generator)
    samples = torch.tensor([0.55, 0.2]) + u * torch.tensor([0.4, 0.6])
    exact = box_target(grid, (0.55, 0.2), (0.95, 0.8), 0.2)

    def error(n: int) -> float:
        return float((sampled_target(grid, samples[:n], 0.2) / exact - 1).abs().max())

    assert error(40_000) < 0.05
    assert error(40_000) < error(100) / 3


def test_pieces_of_samples_add_up(monkeypatch: pytest.MonkeyPatch) -> None:
    samples = torch.rand(50, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * 3
    whole = sampled_target(LINE, samples, 0.3)
    monkeypatch.setattr("torchrl_her.goal_grid._CHUNK", 21)  # seven samples at once
    assert sampled_target(LINE, samples, 0.3).tolist() == pytest.approx(whole.tolist(), rel=1e-12)
    z = (LINE.centres - samples.T) / 0.3
    direct = (-0.5 * z.square()).exp().sum(1)
    assert whole.tolist() == pytest.approx((direct / direct.sum()).tolist(), rel=1e-12)


def test_samples_and_a_tiny_sigma_leave_the_nearest_cell() -> None:
    assert sampled_target(LINE, torch.tensor([[1.4]]), 1e-300).tolist() == [0.0, 1.0, 0.0]


@settings(max_examples=150, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.floats(-10, 10),
            st.floats(1e-3, 10),
            st.integers(1, 5),
            st.floats(-50, 50),
            st.floats(1e-9, 20),
        ),
        min_size=1,
        max_size=3,
    ),
    st.floats(-320, 300),
)
def test_target_is_always_a_distribution(dims: list[tuple[float, ...]], magnitude: float) -> None:
    low, size, shape, start, width = (list(each) for each in zip(*dims, strict=True))
    grid = GoalGrid(low, [a + b for a, b in zip(low, size, strict=True)], [int(n) for n in shape])
    end = [a + b for a, b in zip(start, width, strict=True)]
    for q in (
        box_target(grid, start, end, 10.0**magnitude),
        sampled_target(grid, torch.tensor([start, end]), 10.0**magnitude),
    ):
        assert (q >= 0).all()
        assert float(q.sum()) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("sigma", [0.0, -0.2, math.nan, math.inf, [0.1, 0.0], [0.1, 0.1, 0.1]])
def test_bad_sigmas_are_named(sigma: Any) -> None:
    with pytest.raises(
        ValueError, match="sigma must be positive and finite, one number or 2, got .*[0-9naif]"
    ):
        RIGHT(sigma)
    with pytest.raises(ValueError, match="sigma must be positive and finite"):
        sampled_target(SCREEN, torch.zeros(3, 2), sigma)


@pytest.mark.parametrize(
    ("low", "high"),
    [
        ((0.1, 0.5), (0.9, 0.5)),  # a line
        ((0.9, 0.1), (0.1, 0.9)),
        ((0.1,), (0.9,)),
        ((0.1, math.nan), (0.9, 0.9)),
        ((0.1, 0.1), (0.9, math.inf)),
    ],
)
def test_boxes_without_a_volume_are_named(low: Any, high: Any) -> None:
    with pytest.raises(ValueError, match=r"^layer 1: the box of goals needs a volume.*got low=\(0.[19]"):
        box_target(SCREEN, low, high, 0.2, name="layer 1")
    with pytest.raises(ValueError, match="^the box of goals"):
        box_target(SCREEN, low, high, 0.2)


@pytest.mark.parametrize(
    "samples", [torch.zeros(0, 2), torch.zeros(2), torch.zeros(4, 3), torch.full((1, 2), math.nan)]
)
def test_bad_samples_are_named(samples: Tensor) -> None:
    with pytest.raises(ValueError, match=r"samples must be finite, \[n, 2\] with n > 0, got a shape of"):
        sampled_target(SCREEN, samples, 0.2)


# The divergence


def test_divergence_by_hand() -> None:
    q, q_star = torch.tensor([0.5, 0.5, 0.0]), torch.tensor([0.25, 0.25, 0.5])
    assert float(kl_divergence(q, q_star)) == pytest.approx(math.log(2))
    assert float(kl_divergence(q_star, q_star)) == 0.0
    assert kl_divergence(torch.stack((q, q_star)), q_star).tolist() == pytest.approx([math.log(2), 0.0])


def test_divergence_is_infinite_where_the_target_has_no_mass() -> None:
    q, q_star = torch.tensor([0.5, 0.5, 0.0]), torch.tensor([1.0, 0.0, 0.0])
    assert float(kl_divergence(q, q_star)) == math.inf
    assert float(kl_divergence(q_star, q_star)) == 0.0  # 0 log 0
    assert math.isfinite(float(kl_divergence(q, q_star.clamp_min(1e-30))))


@settings(max_examples=100, deadline=None)
@given(
    st.lists(st.tuples(*[st.sampled_from([0.0, 5e-324, 1e-30, 0.1, 1.0, 7.0])] * 2), min_size=1, max_size=8)
)
def test_divergence_is_never_nan_nor_negative(pairs: list[tuple[float, float]]) -> None:
    q, q_star = (torch.tensor(each, dtype=torch.float64) for each in zip(*pairs, strict=True))
    if q.sum() > 0 and q_star.sum() > 0:
        assert float(kl_divergence(q / q.sum(), q_star / q_star.sum())) >= 0.0


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


@pytest.mark.parametrize(("relative", "expected"), [(True, 0.02 * 0.75), (False, 0.02)])
def test_floor_is_relative_to_the_largest_target_or_absolute(relative: bool, expected: float) -> None:
    weights = Instructiveness(HALVES, quarters, sigma=0.1, floor=0.02, floor_is_relative=relative)
    weights.update(written(0))
    assert weights(LEFT_AND_RIGHT).tolist() == pytest.approx([expected, 0.75])


def test_default_floor_is_a_share_of_the_largest_target() -> None:
    weights = Instructiveness(HALVES, quarters, sigma=0.1)
    weights.update(written(0))
    assert weights(LEFT_AND_RIGHT).tolist() == pytest.approx([0.0015, 0.75])


def test_without_a_floor_cells_that_have_their_share_get_none() -> None:
    weights = Instructiveness(HALVES, quarters, sigma=0.1, floor=0.0)
    weights.update(written(0, 1))
    assert weights(LEFT_AND_RIGHT).tolist() == [0.0, 0.25]


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
    goals = SCREEN.centres.float()
    assert (weights(goals) > 0).all()
    weights.update(goals)
    assert (weights(goals) > 0).all()
    assert weights.divergence == math.inf  # goals where q* is 0


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.tuples(st.floats(width=32), st.floats(width=32)), max_size=30),
    st.floats(1e-6, 5.0),
    st.floats(0.0, 1.0),
    st.booleans(),
    st.booleans(),
)
def test_weights_are_never_negative_nor_nan(
    points: list[tuple[float, float]], sigma: float, floor: float, relative: bool, subtract: bool
) -> None:
    """Goals of any value, NaN and infinity among them."""
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


def test_weights_follow_sigma() -> None:
    weights = Instructiveness(SCREEN, RIGHT, sigma=0.2)
    far, near = torch.tensor([[0.05, 0.5]]), torch.tensor([[0.75, 0.5]])
    preference = [weights(near) / weights(far)]
    for _ in range(21):
        weights.step()
    assert weights(near) / weights(far) > 5 * preference[0]
    weights.restart()
    assert weights(near) / weights(far) == preference[0]


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


def test_state_puts_back_sigma_and_q_exactly() -> None:
    first, second = (Instructiveness(SCREEN, RIGHT, sigma=0.2) for _ in range(2))
    goals = torch.rand(500, 2, generator=torch.Generator().manual_seed(0))
    first.update(goals)
    for _ in range(5):
        first.step()
    second.load_state_dict(through_a_file(first.state_dict()))
    assert second.sigma == first.sigma
    assert torch.equal(second.counts, first.counts)
    for weights in (first, second):  # they go on alike, too
        weights.step()
        weights.update(goals[:7])
    assert torch.equal(second(goals), first(goals))
    assert second.divergence == first.divergence


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


def make_buffer(weights: GoalWeights | None, *, seed: int = 0, **options: Any) -> TensorDictReplayBuffer:
    writer = HERWriter(GoalReward(0.01), weights=weights, **options)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(100_000), writer=writer, batch_size=4)
    buffer.set_rng(torch.Generator().manual_seed(seed))
    return buffer


def scattered(episodes: int, length: int = 20, *, seed: int = 0) -> Any:
    """Episodes that achieve goals anywhere on the screen, more often at its left."""
    batch = make_batch([[length]] * episodes)
    path = torch.rand(episodes, length + 1, 2, generator=torch.Generator().manual_seed(seed))
    path[..., 0].square_()
    batch["achieved_goal"], batch["next", "achieved_goal"] = path[:, :-1].clone(), path[:, 1:].clone()
    return batch


def virtual_goals(buffer: TensorDictReplayBuffer) -> Tensor:
    rows = buffer[:]
    return rows["desired_goal"][rows["virtual"].squeeze(-1)]


def test_goals_are_written_as_their_weights_say() -> None:
    grid = GoalGrid((0.0, 0.0), (1.0, 1.0), (2, 1))
    batch = make_batch([[2]] * 2_000)
    path = torch.tensor([[0.5, 0.5], [0.1, 0.5], [0.9, 0.5]])  # a goal in each half
    batch["achieved_goal"][:], batch["next", "achieved_goal"][:] = path[:-1], path[1:]
    weights = Instructiveness(grid, quarters, sigma=0.2)
    buffer = make_buffer(weights, strategy="episode", k=4)
    buffer.extend(batch)
    share = (virtual_goals(buffer)[:, 0] > 0.5).float().mean()
    assert float(share) == pytest.approx(0.75, abs=0.02)  # six standard deviations
    assert weights.counts.tolist() == [int((1 - share) * 16_000 + 0.5), int(share * 16_000 + 0.5)]


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
        goals = virtual_goals(buffer)
        assert torch.equal(weights.counts, SCREEN.cell(goals).bincount(minlength=400))
        inside = ((goals > torch.tensor([0.55, 0.2])) & (goals < torch.tensor([0.95, 0.8]))).all(-1)
        share.append(float(inside.float().mean()))
    assert share[0] < share[1] < share[2]
    assert ibs.divergence < sequential.divergence < her.divergence_to(RIGHT(0.2))
    assert ibs.divergence < 0.5 * her.divergence_to(RIGHT(0.2))


def test_a_goal_that_moves_nowhere_and_starts_in_the_box_does_not_crowd_out_the_others() -> None:
    weights = Instructiveness(SCREEN, RIGHT, sigma=0.2)
    buffer = make_buffer(weights)
    batch = scattered(100)
    batch["achieved_goal"][::2], batch["next", "achieved_goal"][::2] = 0.75, 0.75
    for _ in range(3):
        buffer.extend(batch)
    assert float(weights(torch.tensor([0.75, 0.75]))) == pytest.approx(0.002 * float(weights.q_star.max()))
    assert len(virtual_goals(buffer)) == 3 * 100 * 20 * 4  # nothing else was on offer: the floor lets it in


def test_the_writer_carries_q_and_sigma() -> None:
    first, second = (make_buffer(Instructiveness(SCREEN, RIGHT, sigma=0.2)) for _ in range(2))
    first.extend(scattered(20))
    first.writer.weights.step()
    second.writer.load_state_dict(through_a_file(first.writer.state_dict()))
    assert torch.equal(second.writer.weights.counts, first.writer.weights.counts)
    assert second.writer.weights.sigma == first.writer.weights.sigma
    for buffer in (first, second):
        buffer.set_rng(torch.Generator().manual_seed(5))
        buffer.extend(scattered(20, seed=1))
    assert torch.equal(second.writer.weights.q, first.writer.weights.q)


def test_emptying_the_buffer_clears_q() -> None:
    buffer = make_buffer(Instructiveness(SCREEN, RIGHT, sigma=0.2))
    buffer.extend(scattered(5))
    buffer.writer.weights.step()
    sigma = buffer.writer.weights.sigma
    buffer.empty()
    assert not buffer.writer.weights.q.any()
    assert torch.equal(
        buffer.writer.weights(SCREEN.centres), RIGHT(sigma).clamp_min(0.002 * RIGHT(sigma).max())
    )
    assert buffer.writer.weights.sigma == sigma
