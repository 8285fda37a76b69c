"""Computes interquartile means and their bootstrap intervals, with SciPy and `arch`.

Agarwal et al., *Deep Reinforcement Learning at the Edge of the Statistical Precipice*, 2021, recommend these
statistics for a few runs on each of several tasks.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

try:
    from arch.bootstrap import IndependentSamplesBootstrap
    from scipy.stats import trim_mean
except ImportError as error:  # these large packages are in an extra, since only reports need them
    raise ImportError("reports need the package arch: pip install '.[report]'") from error

REPETITIONS = 2_000
_SIZE = 0.95  # coverage of the confidence intervals
_CUT = 0.25  # fraction of the runs that is cut off at each end


class Interval(NamedTuple):
    """A value with the ends of its 95 % confidence interval, which are NaN if there are too few samples."""

    value: float
    low: float
    high: float

    def overlaps(self, other: Interval) -> bool:
        """Returns whether this interval and another one have a point in common.

        Example:
            >>> Interval(0.2, 0.1, 0.3).overlaps(Interval(0.5, 0.3, 0.6))
            True
        """
        return not (self.low > other.high or self.high < other.low)


def interquartile_means(groups: Sequence[Sequence[float] | np.ndarray]) -> np.ndarray:
    """Computes the mean of the middle half of each group of values, [G].

    Example:
        >>> interquartile_means([[0.0, 0.5, 0.7, 9.0], [1.0, 2.0]]).tolist()
        [0.6, 1.5]
    """
    means = np.empty(len(groups))
    for size in {len(group) for group in groups}:  # groups of equal size at once, since a bootstrap is slow
        places = [place for place, group in enumerate(groups) if len(group) == size]
        means[places] = trim_mean(np.array([groups[place] for place in places]), _CUT, axis=1)
    return means


def bootstrap(
    samples: Sequence[Sequence[float]],
    groups: Sequence[Sequence[int]],
    pairs: Sequence[tuple[int, int]] = (),
    *,
    repetitions: int = REPETITIONS,
    seed: int = 0,
) -> tuple[list[Interval], list[Interval]]:
    """Computes interquartile means of groups of samples, and their differences, with 95 % intervals.

    The bootstrap is stratified: each repetition redraws every sample (the runs of one algorithm on one task)
    by itself, so that each task keeps its number of runs in a group (one algorithm on several tasks).

    Args:
        samples: results of the runs in each sample.
        groups: indices of the samples over which each mean is taken.
        pairs: pairs of indices of groups; the mean of the second is subtracted from the mean of the first.
        repetitions: number of repetitions of the bootstrap.
        seed: seed of the bootstrap's random numbers.

    Returns:
        One interval for each group, and one for each pair. The ends of an interval are NaN if one of its
        samples has a single run.

    Example:
        >>> means, differences = bootstrap([[0.5, 0.5], [0.25, 0.25]], [[0], [1]], [(0, 1)])
        >>> differences
        [Interval(value=0.25, low=0.25, high=0.25)]
    """
    if not groups:
        return [], []

    firsts, seconds = np.array(pairs, dtype=int).reshape(-1, 2).T

    def statistic(*drawn: np.ndarray) -> np.ndarray:
        means = interquartile_means([np.concatenate([drawn[index] for index in group]) for group in groups])
        return np.concatenate([means, means[firsts] - means[seconds]])

    arrays = [np.asarray(sample, dtype=float) for sample in samples]
    drawing = IndependentSamplesBootstrap(*arrays, seed=seed)
    ends = drawing.conf_int(statistic, repetitions, method="percentile", size=_SIZE)
    enough = [all(len(arrays[index]) > 1 for index in group) for group in groups]
    enough += [enough[first] and enough[second] for first, second in pairs]
    numbers = np.vstack([statistic(*arrays), np.where(enough, ends, np.nan)])
    intervals = [Interval(*row) for row in numbers.T.tolist()]
    return intervals[: len(groups)], intervals[len(groups) :]
