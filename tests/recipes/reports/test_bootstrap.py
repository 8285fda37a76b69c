"""Interquartile means and their intervals, with numbers worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from torchrl_her_recipes.reports.bootstrap import bootstrap, interquartile_means


def test_interquartile_means_leave_out_a_quarter_at_either_end() -> None:
    means = interquartile_means([[0.0, 0.1, 0.3, 0.9], [0.5, 0.7, 0.9, 1.0], [5.0, 1.0, 3.0, 2.0, 90.0]])
    assert means.tolist() == pytest.approx([0.2, 0.8, 10.0 / 3.0])  # of five, one at either end


def test_a_bootstrap_keeps_to_its_strata() -> None:
    """Runs of one task never stand in for those of another: without strata the mean would move."""
    (mean,), _ = bootstrap([[0.0] * 6, [1.0] * 6], [[0, 1]], repetitions=200)
    assert (mean.value, mean.low, mean.high) == (0.5, 0.5, 0.5)


def test_intervals_hold_the_mean_and_grow_with_the_spread() -> None:
    rng = np.random.default_rng(0)
    narrow, wide = rng.normal(0.5, 0.01, 15), rng.normal(0.5, 0.2, 15)
    (first, second), (gap,) = bootstrap([narrow, wide], [[0], [1]], [(0, 1)], repetitions=500)
    assert first.low < first.value < first.high
    assert 5 * (first.high - first.low) < second.high - second.low
    assert gap.value == pytest.approx(first.value - second.value)
    again, _ = bootstrap([narrow, wide], [[0], [1]], [(0, 1)], repetitions=500)
    assert again == [first, second]


def test_one_run_has_no_interval() -> None:
    (one, two), (gap,) = bootstrap([[0.5], [0.1, 0.3]], [[0], [1]], [(0, 1)], repetitions=50)
    assert (one.value, two.value) == (0.5, 0.2)
    assert np.isnan([one.low, one.high, gap.low, gap.high]).all()
    assert not np.isnan(two.low)
