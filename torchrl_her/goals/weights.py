"""Weights of goals: which virtual goals are drawn more often than others."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

GOLDEN = (5**0.5 - 1) / 2  # multiples of it have fractional parts that are spread evenly over any range


class GoalWeights:
    """Measure of how useful each achieved goal is as a virtual goal. Subclass it for a measure of your own.

    The base class gives all goals the same weight and has no state.

    Attributes:
        is_uniform: True promises that all weights are equal, so that they need not be computed.

    Example:
        >>> class PreferRight(GoalWeights):
        ...     def __call__(self, goals):
        ...         return goals[..., 0].clamp_min(0.0)
        >>> PreferRight()(torch.tensor([[-1.0, 0.0], [2.0, 0.0]]))
        tensor([0., 2.])
    """

    is_uniform: bool = False

    def __call__(self, goals: Tensor) -> Tensor:
        """Returns weights [...] of at least 0 for goals [..., g]."""
        return goals.new_ones(goals.shape[:-1])

    def update(self, goals: Tensor) -> None:
        """Hook that is called with the virtual goals [n, g] that were written or sampled."""

    def clear(self) -> None:
        """Hook that is called when the writer's buffer was emptied."""

    def state_dict(self) -> dict[str, Any]:
        """Returns tensors and plain data that :meth:`load_state_dict` takes."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores the state that :meth:`state_dict` returned."""

    @classmethod
    def of_runs(cls, weights: Sequence[GoalWeights]) -> WeightsOfRuns:
        """Combines the weights of several runs, all of this class, into one object for all runs."""
        return WeightsOfRuns(weights)


class WeightsOfRuns:
    """Weights of the goals of several runs, from one :class:`GoalWeights` for each run.

    Args:
        weights: R objects, one for each run; they are called one after the other.

    Example:
        >>> class Times(GoalWeights):
        ...     def __init__(self, factor):
        ...         self.factor = factor
        ...
        ...     def __call__(self, goals):
        ...         return self.factor * goals[..., 0]
        >>> both = WeightsOfRuns([Times(1.0), Times(10.0)])
        >>> both(torch.tensor([[3.0], [4.0], [5.0]]), [0, 1], [1, 2]).tolist()
        [3.0, 40.0, 50.0]
    """

    def __init__(self, weights: Sequence[GoalWeights]) -> None:
        self.weights = weights

    def __call__(self, goals: Tensor, runs: Sequence[int], counts: Sequence[int]) -> Tensor:
        """Returns the weights [n, ...] of goals of the given runs.

        Args:
            goals: [n, ..., g], run after run.
            runs: indices of m runs.
            counts: number of goals of each of the m runs; they sum to n.
        """
        parts = goals.split(list(counts))
        return torch.cat([self.weights[run](part) for run, part in zip(runs, parts, strict=True)])

    def update(self, goals: Tensor, runs: Sequence[int], counts: Sequence[int]) -> None:
        """Updates the weights of the given runs with the virtual goals [n, g] that were written."""
        for run, part in zip(runs, goals.split(list(counts)), strict=True):
            if len(part):
                self.weights[run].update(part)


def weights_by_run(
    weights: GoalWeights | Sequence[GoalWeights] | None, runs: int | None = None
) -> list[GoalWeights]:
    """Returns the weights of R runs, or of any number of runs, as a list; an empty list for None.

    Raises:
        ValueError: the number of weights is not R.
    """
    run_weights = list(weights) if isinstance(weights, Sequence) else [] if weights is None else [weights]
    if runs is not None and run_weights and len(run_weights) != runs:
        raise ValueError(
            f"{runs} runs need a list of {runs} weights, one for each run, got {len(run_weights)}"
        )
    return run_weights


def checked_weights(weight: Tensor, goals: Tensor) -> Tensor:
    """Checks weights [...] of goals [..., g], and returns them as floating-point numbers.

    Raises:
        ValueError: the numbers of weights and goals differ, or some weights are negative or not finite.
    """
    if weight.shape != goals.shape[:-1]:
        raise ValueError(
            f"weights of goals must be {list(goals.shape[:-1])} for goals {list(goals.shape)}, got "
            f"{list(weight.shape)}"
        )
    weight = weight if weight.is_floating_point() else weight.float()
    if weight.numel() > 0:
        least, most = weight.aminmax()
        if not bool((least >= 0) & (most < torch.inf)):  # NaN fails both
            raise ValueError(f"weights of goals must be finite and at least 0, got {least} to {most}")
    return weight


def normalized_weights(logs: Tensor, goals: Tensor) -> Tensor:
    """Computes weights from their logarithms: the largest is 1, and none is rounded to 0.

    Args:
        logs: [...], logarithms of the weights; NaN for a goal that must not be drawn.
        goals: [..., g], the goals that the weights belong to.

    Returns:
        Weights [...], 0 where ``logs`` are NaN; in the goals' dtype if it is floating-point.

    Example:
        >>> normalized_weights(torch.tensor([800.0, 801.0, -1e6, torch.nan]), torch.zeros(4, 2)).tolist()
        [0.3678794503211975, 1.0, 1.1754943508222875e-38, 0.0]
    """
    dtype = goals.dtype if goals.is_floating_point() else torch.get_default_dtype()
    refused = logs.isnan()
    logs = logs.masked_fill(refused, -torch.inf)
    weight = (logs - logs.amax()).exp().to(dtype).clamp_min(torch.finfo(dtype).tiny)
    return weight.masked_fill_(refused, 0.0)


def spread_evenly(count: int, most: int, device: torch.device | None = None) -> Tensor:
    """Returns the indices of ``count`` items, or of ``most`` evenly spread ones if there are more.

    The items are divided into equal parts, and one is chosen in each part, at a place that changes from part
    to part. If it were always the first place, and if each part were one episode, all chosen items would be
    first transitions.

    Example:
        >>> spread_evenly(3, 5).tolist(), spread_evenly(12, 4).tolist()
        ([0, 1, 2], [0, 4, 6, 11])
    """
    n = min(count, most)
    part = torch.arange(n, device=device)
    begin, end = part * count // max(n, 1), (part + 1) * count // max(n, 1)
    share = (part.double() * GOLDEN).frac()  # place within each part, which varies between neighbors
    return begin + ((end - begin) * share).long()
