"""Computes results of a study's combinations and their differences, and judges the study's expectations."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import combinations
from typing import Any

import numpy as np

from torchrl_her_recipes.config.study import Order
from torchrl_her_recipes.reports.bootstrap import Interval, bootstrap
from torchrl_her_recipes.reports.results import Combination
from torchrl_her_recipes.runs.scores import LAST, at_the_end

ALL_TASKS = "all tasks"
_COUNTED = ("kl", "rows_")  # metrics that accumulate over a run, so that only their last value counts


@dataclass(frozen=True)
class Final:
    """Result of one algorithm on one task, or on all tasks together: a row of the table of results."""

    measure: str
    task: str
    algorithm: str
    finished: bool
    runs: int
    frames: int
    iqm: float
    low: float
    high: float
    median: float
    percentile_33: float
    percentile_67: float
    least: float
    most: float
    published: float | None


@dataclass(frozen=True)
class Difference:
    """Difference between the interquartile means of two algorithms: a row of the table of differences.

    ``apart`` is true if the intervals of the two means have no point in common.
    """

    measure: str
    task: str
    first: str
    second: str
    difference: float
    low: float
    high: float
    apart: bool

    def minus_other(self, first: str) -> Interval:
        """Returns the mean of ``first``, one of the two algorithms, minus the mean of the other."""
        if first == self.first:
            return Interval(self.difference, self.low, self.high)
        return Interval(-self.difference, -self.high, -self.low)


class Verdict(StrEnum):
    """Outcome of an expected order of two algorithms; see :func:`judge`."""

    APART = "holds, apart"  # the intervals of the two algorithms have no point in common
    HOLDS = "holds, overlap"
    UNDECIDED = "undecided"
    REVERSED = "reversed"
    OPEN = "not known yet"


@dataclass(frozen=True)
class Judged:
    """An expected order of two algorithms on one task, with its verdict: a row of the table of orders."""

    measure: str
    task: str
    order: str
    verdict: Verdict
    difference: float
    low: float
    high: float
    why: str


def values_of(cell: Combination, measure: str) -> list[float]:
    """Returns the value of a metric at the end of each run; runs whose value is NaN are left out."""
    if not cell.has(measure):
        return []
    last = 1 if measure.startswith(_COUNTED) else LAST
    values = at_the_end(cell.rows, measure, evaluations=last)
    return [value for value in values if not math.isnan(value)]


def compare(
    cells: Sequence[Combination], measure: str, published: Mapping[str, Any]
) -> tuple[list[Final], list[Difference]]:
    """Returns the results of all combinations in a metric, and differences of algorithms on the same task.

    Differences are computed only between algorithms whose runs are finished. Algorithms whose runs are
    finished on all tasks of the study are also compared on all tasks together.
    """
    measured = [cell for cell in cells if values_of(cell, measure)]
    samples = [values_of(cell, measure) for cell in measured]
    keys = [(cell.task, cell.algorithm) for cell in measured]
    groups = [[index] for index in range(len(measured))]
    for algorithm in _complete(cells, measured):
        keys.append((ALL_TASKS, algorithm))
        groups.append([index for index, cell in enumerate(measured) if cell.algorithm == algorithm])
    final = [all(measured[index].done for index in group) for group in groups]
    pairs = [
        (first, second)  # the later algorithm minus the earlier one, which is plain HER in most studies
        for second, first in combinations(range(len(keys)), 2)
        if keys[first][0] == keys[second][0] and final[first] and final[second]
    ]
    means, gaps = bootstrap(samples, groups, pairs)
    finals, numbers = [], published.get("numbers", {}).get(measure, {})
    for key, group, mean, finished in zip(keys, groups, means, final, strict=True):
        pooled = [value for index in group for value in samples[index]]
        low, middle, high = np.percentile(pooled, [33, 50, 67]).tolist()
        frames = max(measured[index].frames for index in group)
        spread = (*mean, middle, low, high, min(pooled), max(pooled))
        number = numbers.get(key[0], {}).get(key[1])
        finals.append(Final(measure, *key, finished, len(pooled), frames, *spread, number))
    differences = [
        Difference(measure, *keys[first], keys[second][1], *gap, not means[first].overlaps(means[second]))
        for (first, second), gap in zip(pairs, gaps, strict=True)
    ]
    return finals, differences


def _complete(cells: Sequence[Combination], measured: Sequence[Combination]) -> list[str]:
    """Returns the algorithms whose runs are finished on all tasks; none if the study has a single task."""
    tasks = {cell.task for cell in cells}
    counts = Counter(cell.algorithm for cell in measured if cell.done)
    return [name for name, count in counts.items() if count == len(tasks) > 1]


def judge(
    cells: Sequence[Combination], orders: Sequence[Order], differences: Sequence[Difference]
) -> list[Judged]:
    """Judges whether expected orders hold, on each task of a study and, for success, on all tasks together.

    An order holds if the 95 % interval of the difference lies on the expected side of 0. A verdict also tells
    whether the order passes a stricter test: that the intervals of both algorithms have no point in common.

    Args:
        cells: combinations of the study.
        orders: the expected orders; those that name an algorithm without results are left out.
        differences: differences from :func:`compare`.
    """
    tasks = list(dict.fromkeys(cell.task for cell in cells))
    algorithms = {cell.algorithm for cell in cells}
    judged = []
    for order in orders:
        if {order.more, order.less} <= algorithms:
            everywhere = [ALL_TASKS] if order.measure == "success" and len(tasks) > 1 else []
            judged += [_judge(cells, order, task, differences) for task in tasks + everywhere]
    return judged


def _judge(
    cells: Sequence[Combination], order: Order, task: str, differences: Sequence[Difference]
) -> Judged:
    pair = {order.more, order.less}
    for gap in differences:
        if (gap.measure, gap.task) == (order.measure, task) and {gap.first, gap.second} == pair:
            verdict = _verdict(gap.minus_other(order.more), apart=gap.apart)
            why = "too few runs" if verdict is Verdict.OPEN else ""
            written = gap.minus_other(order.text.split()[0])  # as written: for a < b, a minus b
            return Judged(order.measure, task, order.text, verdict, *written, why)
    unknown = (math.nan, math.nan, math.nan)
    return Judged(order.measure, task, order.text, Verdict.OPEN, *unknown, _why(cells, order, task))


def _verdict(rise: Interval, *, apart: bool) -> Verdict:
    """Returns the verdict on an order; ``rise`` is the mean expected to be greater minus the other mean."""
    if math.isnan(rise.low):
        return Verdict.OPEN
    if rise.low > 0:
        return Verdict.APART if apart else Verdict.HOLDS
    return Verdict.REVERSED if rise.high < 0 else Verdict.UNDECIDED


def _why(cells: Sequence[Combination], order: Order, task: str) -> str:
    """Returns the reason why an order cannot be judged yet, such as unfinished runs."""
    lacking = [
        f"{cell.label} is {cell.state}"
        for cell in cells
        if cell.algorithm in (order.more, order.less) and task in (cell.task, ALL_TASKS) and not cell.done
    ]
    return ", ".join(lacking) or f"runs without {order.measure}"
