"""The grid, the target q* and the divergence from it."""

from __future__ import annotations

import math
from functools import reduce
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from torchrl_her import GoalGrid, box_target
from torchrl_her.goals import kl_divergence, sampled_target

from ..goal_grids import LINE, RIGHT, SCREEN

# The grid


def test_cells_by_hand() -> None:
    grid = GoalGrid((0.0, -1.0, 10.0), (2.0, 1.0, 40.0), (2, 4, 3))
    goals = torch.tensor([[0.5, -0.9, 12.0], [0.5, -0.9, 25.0], [0.5, -0.1, 12.0], [1.5, 0.9, 39.0]])
    assert grid.num_cells == 24
    assert grid.cell(goals).tolist() == [0, 1, 3, 23]
    assert grid.cell(goals.double().view(2, 2, 3)).tolist() == [[0, 1], [3, 23]]
    assert grid.centers[23].tolist() == [1.5, 0.75, 35.0]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_every_center_lies_in_its_own_cell(dtype: torch.dtype) -> None:
    grid = GoalGrid((-1.0, 0.3, 5.0), (1.0, 0.4, 500.0), (7, 20, 3))
    assert torch.equal(grid.cell(grid.centers.to(dtype)), torch.arange(420))


def test_the_edges_of_the_box_belong_to_the_cells_at_the_edge() -> None:
    corners = torch.tensor([[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0], [1.0 + 1e-6, -1e-6]])
    assert SCREEN.cell(corners).tolist() == [0, 19, 380, 399, 380]


def test_goals_less_than_a_cell_outside_count_at_the_edge_without_a_word() -> None:
    grid = GoalGrid((0.0, 0.0), (1.0, 1.0), (2, 4))
    assert grid.cell(torch.tensor([[-0.49, 1.24], [1.49, -0.24]])).tolist() == [3, 4]
    with pytest.warns(UserWarning, match=r"goal \[0.5, 1.375\] lies outside"):
        grid.cell(torch.tensor([[-0.49, 1.24], [0.5, 1.375]]))


def test_goals_outside_count_at_the_edge_and_are_named_once() -> None:
    grid = GoalGrid((0.0, 0.0), (1.0, 1.0), (2, 2))
    goals = torch.tensor([[0.1, 0.1], [0.25, 7.5], [-3e38, 3e38], [3e38, -3e38]])
    with pytest.warns(
        UserWarning, match=r"goal \[0.25, 7.5\] lies outside.*low=\(0.0, 0.0\), high=\(1.0, 1.0\)"
    ):
        assert grid.cell(goals).tolist() == [0, 1, 1, 2]
    assert grid.cell(goals).tolist() == [0, 1, 1, 2]  # warnings are errors here: it is said once
    with pytest.warns(UserWarning, match="lies outside"):  # once for each grid
        GoalGrid(0.0, 1.0, [2]).cell(torch.tensor([[2.0]]))


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_goals_that_are_not_finite_are_in_no_cell(bad: float) -> None:
    grid = GoalGrid((0.0, 0.0), (1.0, 1.0), (2, 2))
    with pytest.raises(ValueError, match=f"goals must be finite, got {bad} in it"):
        grid.cell(torch.tensor([[0.1, 0.1], [0.75, bad]]))


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
    squares = [((points - center) / unit).square().sum(-1) for center in grid.centers]
    mu = torch.stack([((-square / 2).exp() * weight).sum() for square in squares])
    expected = mu / mu.sum()
    error = (box_target(grid, low, high, sigma) / expected - 1).abs().max()
    assert error < 1e-6


def test_one_sigma_stands_for_all_dimensions() -> None:
    assert torch.equal(RIGHT(0.2), RIGHT((0.2, 0.2)))
    assert not torch.equal(RIGHT(0.2), RIGHT((0.2, 0.1)))


def test_far_tails_keep_their_digits() -> None:
    # 31 and 30 sigma away: Q(30) / Q(31) from the asymptotic series Q(x) = phi(x) / x (1 - 1 / x^2 + ...)
    q = box_target(GoalGrid(-0.5, 1.5, [2]), 31.0, 1e3, 1.0)  # centers at 0 and 1

    def tail(x: float) -> float:
        return sum(t / x ** (2 * i + 1) for i, t in enumerate((1, -1, 3, -15, 105, -945)))

    assert float(q[1] / q[0]) == pytest.approx(math.exp(30.5) * tail(30.0) / tail(31.0), rel=1e-7)


@pytest.mark.parametrize("sigma", [1e-5, 1e-30, 1e-300, 5e-324])
def test_a_tiny_sigma_leaves_the_cells_in_the_box_or_the_nearest_one(sigma: float) -> None:
    assert box_target(LINE, 0.0, 2.0, sigma).tolist() == [0.5, 0.5, 0.0]
    assert box_target(LINE, 0.6, 0.9, sigma).tolist() == [1.0, 0.0, 0.0]  # between centers
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
    monkeypatch.setattr("torchrl_her.goals.grid._CHUNK", 21)  # seven samples at once
    assert sampled_target(LINE, samples, 0.3).tolist() == pytest.approx(whole.tolist(), rel=1e-12)
    z = (LINE.centers - samples.T) / 0.3
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
        ValueError, match="sigma must be positive and finite, a scalar or of length 2, got .*[0-9naif]"
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
    with pytest.raises(ValueError, match=r"^stage 1: the box of goals needs a volume.*got low=\(0.[19]"):
        box_target(SCREEN, low, high, 0.2, name="stage 1")
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
