"""Densities by hand, against distributions of torch, and in many dimensions."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.distributions import Normal

from torchrl_her.goals import density, log_kernel_density, log_neighbor_density


def random(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.randn(shape, dtype=dtype, generator=torch.Generator().manual_seed(seed))


def test_a_kernel_density_by_hand() -> None:
    samples = torch.tensor([[0.0, 0.0], [0.0, 3.0]])
    at = log_kernel_density(torch.tensor([0.0, 0.0]), samples, 1.0)
    assert float(at) == pytest.approx(math.log((1.0 + math.exp(-4.5)) / 2 / (2 * math.pi)))
    wide = log_kernel_density(torch.tensor([0.0, 0.0]), samples, [1.0, 3.0])  # the second is 1 sigma away
    assert float(wide) == pytest.approx(math.log((1.0 + math.exp(-0.5)) / 2 / (2 * math.pi * 3.0)))


@pytest.mark.parametrize("g", [1, 3, 30])
def test_a_kernel_density_is_a_mixture_of_normal_distributions(g: int) -> None:
    samples, points = random(7, g), random(4, 5, g, seed=1)
    sigma = random(g, seed=2).exp()
    each = Normal(samples, sigma).log_prob(points.unsqueeze(-2)).sum(-1)
    expected = each.logsumexp(-1) - math.log(7)
    torch.testing.assert_close(log_kernel_density(points, samples, sigma), expected)


def test_a_kernel_density_integrates_to_1() -> None:
    at = torch.linspace(-20.0, 20.0, 4001, dtype=torch.float64).unsqueeze(-1)
    found = log_kernel_density(at, torch.tensor([[-3.0], [0.5], [4.0]]), 0.7).exp()
    assert float(found.sum() * 0.01) == pytest.approx(1.0, abs=1e-9)


def test_a_neighbor_density_by_hand() -> None:
    samples = torch.tensor([[0.0, 0.0], [3.0, 4.0], [0.0, 10.0]])
    point = torch.tensor([[0.0, 0.0], [0.0, 2.0]])
    # The second nearest is 5 away, and 3.6: two of three samples in a disk of this radius.
    expected = [2 / 3 / (math.pi * 25.0), 2 / 3 / (math.pi * 13.0)]
    assert log_neighbor_density(point, samples, 2).exp().tolist() == pytest.approx(expected)
    # In three dimensions the ball is 4/3 pi r^3.
    samples, point = torch.tensor([[0.0, 0.0, 2.0]]), torch.zeros(3)
    assert float(log_neighbor_density(point, samples, 1)) == pytest.approx(-math.log(4 / 3 * math.pi * 8.0))


def test_equal_samples_have_the_density_of_the_least_distance() -> None:
    samples, point = torch.ones(4, 2), torch.ones(1, 2)
    for least in (1e-6, 0.5):
        found = log_neighbor_density(point, samples, 4, least_distance=least)
        assert float(found) == pytest.approx(-math.log(math.pi * least**2))


def test_small_distances_far_from_0_are_exact() -> None:
    samples = torch.tensor([[1e6, 0.0], [-1e6, 0.0]], dtype=torch.float64)
    near = samples[0] + torch.tensor([0.0, 1e-4], dtype=torch.float64)
    found = log_neighbor_density(near, samples, 1)
    assert float(found) == pytest.approx(math.log(0.5 / (math.pi * 1e-8)), rel=1e-12)


@pytest.mark.parametrize(("g", "sigma"), [(1, 0.1), (2, 0.3), (15, 1.0), (30, 1.0)])
def test_both_find_the_density_of_a_normal_distribution(g: int, sigma: float) -> None:
    samples, points = random(20_000, g), random(200, g, seed=1)
    truth = Normal(0.0, 1.0).log_prob(points).sum(-1)
    for found in (log_kernel_density(points, samples, sigma), log_neighbor_density(points, samples, 100)):
        assert bool(found.isfinite().all())
        assert float(torch.corrcoef(torch.stack([truth, found]))[0, 1]) > 0.95
        if g <= 2:
            assert float((found - truth).abs().median()) < 0.1


@pytest.mark.parametrize("shape", [(2,), (5, 2), (3, 4, 2), (0, 2), (2, 0, 2)])
def test_any_batch_shape(shape: tuple[int, ...]) -> None:
    points, samples = random(*shape), random(6, 2)
    for found in (log_kernel_density(points, samples, 0.5), log_neighbor_density(points, samples, 2)):
        assert found.shape == shape[:-1]
        assert found.dtype == torch.float64


def test_parts_are_computed_one_after_the_other(monkeypatch: pytest.MonkeyPatch) -> None:
    points, samples = random(23, 3), random(6, 3, seed=1)
    whole = log_kernel_density(points, samples, 0.5), log_neighbor_density(points, samples, 2)
    monkeypatch.setattr(density, "_CHUNK", 30)  # five points at once, and one
    parts = log_kernel_density(points, samples, 0.5), log_neighbor_density(points, samples, 2)
    torch.testing.assert_close(parts, whole)


NUMBERS = st.floats(-1e300, 1e300) | st.floats(-10.0, 10.0) | st.sampled_from([math.nan, math.inf, -math.inf])


@settings(max_examples=100, deadline=None)
@given(
    st.lists(st.tuples(NUMBERS, NUMBERS), min_size=1, max_size=8),
    st.lists(st.tuples(*[st.floats(-1e30, 1e30)] * 2), min_size=1, max_size=5),
    st.floats(1e-6, 1e6),
)
def test_densities_are_finite_wherever_points_are(
    points: list[tuple[float, float]], samples: list[tuple[float, float]], sigma: float
) -> None:
    at = torch.tensor(points, dtype=torch.float64)
    known = torch.tensor(samples, dtype=torch.float64)
    given_points = at.isfinite().all(-1)
    for found in (log_kernel_density(at, known, sigma), log_neighbor_density(at, known, len(samples))):
        assert torch.equal(found.isfinite(), given_points)
        assert torch.equal(found.isnan(), ~given_points)


@pytest.mark.parametrize(
    ("points", "samples", "options", "message"),
    [
        (
            random(3, 2),
            random(0, 2),
            {},
            r"samples must be finite, \[n, g\] with n > 0, got a shape of \[0, 2\]",
        ),
        (random(3, 2), random(2), {}, r"samples must be finite, .* got a shape of \[2\]"),
        (random(3, 2), torch.tensor([[0.0, math.nan]]), {}, "samples must be finite"),
        (
            random(3, 3),
            random(4, 2),
            {},
            r"points must be \[..., 2\] as samples are, got a shape of \[3, 3\]",
        ),
        (
            random(3, 2),
            random(4, 2),
            {"sigma": 0.0},
            "sigma must be positive and finite, a scalar or of length 2, got 0",
        ),
        (random(3, 2), random(4, 2), {"sigma": [1.0] * 3}, "a scalar or of length 2, got .1.0, 1.0, 1.0."),
        (random(3, 2), random(4, 2), {"k": 0}, "k must be from 1 to the number of samples, 4, got 0"),
        (random(3, 2), random(4, 2), {"k": 5}, "k must be from 1 to the number of samples, 4, got 5"),
        (
            random(3, 2),
            random(4, 2),
            {"k": 1, "least_distance": 0.0},
            "least_distance must be positive and finite, got 0.0",
        ),
    ],
)
def test_mistakes_are_named(points: Tensor, samples: Tensor, options: dict[str, Any], message: str) -> None:
    estimate, default = (log_neighbor_density, {}) if "k" in options else (log_kernel_density, {"sigma": 1.0})
    with pytest.raises(ValueError, match=message):
        estimate(points, samples, **{**default, **options})  # type: ignore[operator]
