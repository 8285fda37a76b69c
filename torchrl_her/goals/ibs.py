"""IBS: a goal's weight is its instructiveness, the target density q* minus the density q of virtual goals.

Equations are those of chapter 4 (Instructional Based Strategy) of the thesis that the method is from.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from torchrl_her.checks import check_whole
from torchrl_her.goals.grid import GoalGrid, kl_divergence
from torchrl_her.goals.instructive import InstructiveWeights
from torchrl_her.goals.weights import GoalWeights, WeightsOfRuns


class GoalHistogram(GoalWeights):
    """Counts virtual goals in the cells of a grid, and gives all goals the same weight.

    Args:
        grid: cells to count in.

    Keyword Args:
        recent: number of the newest goals that count; None for all of them.

    Raises:
        ValueError: ``recent`` is below 1.

    Attributes:
        counts: [cells] of int64, on the device of the goals that were counted last.

    Example:
        >>> histogram = GoalHistogram(GoalGrid(0.0, 1.0, [2]))
        >>> histogram.update(torch.tensor([[0.1], [0.2], [0.3], [0.8]]))
        >>> histogram.q.tolist()
        [0.75, 0.25]
    """

    is_uniform = True

    def __init__(self, grid: GoalGrid, *, recent: int | None = None) -> None:
        if recent is not None:
            check_whole(recent=recent)
        self.grid, self.recent = grid, recent
        self.counts = torch.zeros(grid.num_cells, dtype=torch.int64)
        self._newest = torch.zeros(0, dtype=torch.int32)  # cells of the newest goals, if only these count

    @property
    def q(self) -> Tensor:
        """Proposal distribution (thesis, equation 4.8), [cells] of float64; zeros before the first write."""
        return self.counts.double() / self.counts.sum().clamp_min(1)

    def divergence_to(self, q_star: Tensor) -> float:
        """KL(q || q*) in nats for a target [cells]; NaN before the first write, when there is no q."""
        q = self.q
        return float(kl_divergence(q, q_star.to(q))) if q.any() else math.nan

    def update(self, goals: Tensor) -> None:
        cells = self.grid.cell(goals).flatten()
        self._add(cells.bincount(minlength=self.grid.num_cells), cells)

    def _add(self, counts: Tensor, cells: Tensor) -> None:
        self.counts = self.counts.to(counts.device) + counts
        if self.recent is not None:
            newest = torch.cat((self._newest.to(cells.device), cells.int()))
            old = newest[: max(0, len(newest) - self.recent)]
            self.counts -= old.bincount(minlength=self.grid.num_cells)
            self._newest = newest[len(old) :].clone()

    def clear(self) -> None:
        self.counts, self._newest = torch.zeros_like(self.counts), self._newest[:0]

    @classmethod
    def of_runs(cls, weights: Sequence[GoalWeights]) -> WeightsOfRuns:
        return HistogramsOfRuns(weights) if HistogramsOfRuns.fits(weights) else WeightsOfRuns(weights)

    def state_dict(self) -> dict[str, Any]:
        return {"counts": self.counts.clone(), "newest": self._newest.clone()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        if state["counts"].shape != self.counts.shape:
            raise ValueError(f"the grid has {self.grid.num_cells} cells, the state {len(state['counts'])}")
        self.counts = state["counts"].to(self.counts.device, copy=True)
        self._newest = state["newest"].to(self.counts.device, copy=True)


class Instructiveness(InstructiveWeights, GoalHistogram):
    """The weights of IBS: max(q* - q, floor) in a goal's cell (thesis, equations 4.5, 4.9).

    See :class:`~torchrl_her.goals.InstructiveWeights` for the schedule of the kernel's sigma. A grid is too
    large for goals of many dimensions: use :class:`~torchrl_her.goals.KernelInstructiveness` for them.

    Args:
        grid: cells over the range of achieved goals.
        target: maps a sigma to q* [cells], for instance ``partial(box_target, grid, low, high)``.

    Keyword Args:
        sigma: the final standard deviation of the kernel, in the unit of the goals.
        floor_is_relative: whether ``floor`` is multiplied by the largest q*; the thesis's floor is absolute.
        recent: number of the newest virtual goals that q counts; None for all since the buffer was emptied.
        **options: ``start_factor``, ``decay``, ``floor`` and ``subtract`` of
            :class:`~torchrl_her.goals.InstructiveWeights`.

    Attributes:
        sigma, q_star: present values of the kernel's sigma and of the target.
        final_sigma, final_q_star: values of both at the end of the schedule.

    Raises:
        ValueError: an option is out of its range, or the target does not fit the grid.

    Example:
        >>> grid = GoalGrid(0.0, 1.0, [2])
        >>> weights = Instructiveness(grid, lambda sigma: torch.tensor([0.25, 0.75]), sigma=0.2)
        >>> weights(torch.tensor([[0.1], [0.9]])).tolist()
        [0.25, 0.75]
        >>> weights.update(torch.tensor([[0.1], [0.6]]))  # q is now a half each
        >>> weights(torch.tensor([[0.1], [0.9]]))
        tensor([0.0015, 0.2500])
    """

    q_star: Tensor

    def __init__(
        self,
        grid: GoalGrid,
        target: Callable[[float], Tensor],
        *,
        sigma: float,
        floor_is_relative: bool = True,
        recent: int | None = None,
        **options: Any,
    ) -> None:
        GoalHistogram.__init__(self, grid, recent=recent)
        self.target, self.floor_is_relative = target, floor_is_relative
        InstructiveWeights.__init__(self, sigma=sigma, **options)
        self.final_q_star = self._target(sigma)

    @property
    def divergence(self) -> float:
        """KL(q || q*) in nats, with q* at the final and not the present sigma; NaN before the first write."""
        return self.divergence_to(self.final_q_star)

    @property
    def table(self) -> Tensor:
        """The weights [cells] of float64."""
        q_star = self.q_star = self.q_star.to(self.counts.device)
        if not self.subtract:
            return q_star
        floor = self.floor * q_star.max() if self.floor_is_relative else self.floor
        return (q_star - self.q).clamp_min(floor)

    def __call__(self, goals: Tensor) -> Tensor:
        return _look_up(self.table, self.grid.cell(goals), goals)

    def _set_sigma(self, sigma: float) -> None:
        super()._set_sigma(sigma)
        self.q_star = self._target(sigma)

    def _target(self, sigma: float) -> Tensor:
        q_star = self.target(sigma)
        # NaN fails both comparisons
        if q_star.shape != self.counts.shape or not ((q_star >= 0).all() and abs(q_star.sum() - 1) < 1e-3):
            raise ValueError(
                f"the target must give {self.grid.num_cells} numbers of at least 0 that sum to 1, "
                f"got a shape of {list(q_star.shape)}, a least of {q_star.min()}, a sum of {q_star.sum()}"
            )
        return q_star.double()


class HistogramsOfRuns(WeightsOfRuns):
    """Histograms of several runs over one grid, counted and looked up for all runs at once."""

    weights: Sequence[GoalHistogram]

    @staticmethod
    def fits(weights: Sequence[GoalWeights]) -> bool:
        """Returns whether all weights are histograms over one grid; False for subclasses."""
        first = weights[0]
        return type(first) in (GoalHistogram, Instructiveness) and all(
            type(other) is type(first) and other.grid is first.grid  # type: ignore[attr-defined]
            for other in weights
        )

    def __call__(self, goals: Tensor, runs: Sequence[int], counts: Sequence[int]) -> Tensor:
        tables = [
            histogram.table for run in runs if isinstance(histogram := self.weights[run], Instructiveness)
        ]
        if not tables:
            return goals.new_ones(goals.shape[:-1])
        return _look_up(torch.cat(tables), self._cells(goals, counts), goals)

    def update(self, goals: Tensor, runs: Sequence[int], counts: Sequence[int]) -> None:
        size, cells = self.weights[0].grid.num_cells, self._cells(goals, counts)
        added = cells.bincount(minlength=len(runs) * size).view(len(runs), size)
        parts = zip(runs, added, cells.split(list(counts)), strict=True)
        for place, (run, histogram, part) in enumerate(parts):
            self.weights[run]._add(histogram, part - place * size)

    def _cells(self, goals: Tensor, counts: Sequence[int]) -> Tensor:
        """Returns the cell [n, ...] of each goal in the joined tables of the given runs."""
        cells, size = self.weights[0].grid.cell(goals), self.weights[0].grid.num_cells
        for position, part in enumerate(cells.split(list(counts))):
            part += position * size
        return cells


def _look_up(table: Tensor, cells: Tensor, goals: Tensor) -> Tensor:
    """Looks up weights [...] of goals in cells [...], in the type of the goals if it is floating-point."""
    dtype = goals.dtype if goals.is_floating_point() else None
    return table.to(goals.device, dtype).index_select(0, cells.flatten()).view(cells.shape)
