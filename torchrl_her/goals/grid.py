"""Distributions of goals over a grid: the target q* of IBS, and the divergence from it.

Equations are those of chapter 4 (Instructional Based Strategy) of the thesis that the method is from.
"""

from __future__ import annotations

import math
import operator
import warnings
from collections.abc import Iterator, Sequence
from functools import reduce

import torch
from torch import Tensor

from torchrl_her.checks import check_finite

_MAX_CELLS = 1 << 24  # most cells of a grid: a float64 table takes 128 MiB, and five are kept
_CHUNK = 1 << 21  # number of kernel values that are computed at once when summing over samples
_THIN = 1e-4  # boxes thinner than this, in sigmas, are not integrated by differences

Numbers = float | Sequence[float] | Tensor


def _floats(x: Numbers) -> tuple[float, ...]:
    return tuple(torch.as_tensor(x, dtype=torch.float64).reshape(-1).tolist())


class GoalGrid:
    """Grid of equal cells over a box of goals in any number d of dimensions.

    Args:
        low, high: d numbers each, corners of the box, in the unit of the goals.
        shape: number of cells along each of the d dimensions.

    Keyword Args:
        warn: whether to warn, once, when a goal lies farther outside of the box than a cell is wide.

    Raises:
        ValueError: the box has no volume, the lengths differ, or there are no cells or too many.

    Example:
        >>> grid = GoalGrid((0.0, 0.0), (1.0, 1.0), (2, 4))
        >>> grid.cell(torch.tensor([[0.1, 0.1], [0.9, 0.6]])).tolist()
        [0, 6]
        >>> grid.centers[6].tolist()
        [0.75, 0.625]
    """

    def __init__(self, low: Numbers, high: Numbers, shape: Sequence[int], *, warn: bool = True) -> None:
        self.low, self.high = _floats(low), _floats(high)
        self.shape = tuple(operator.index(n) for n in shape)
        if not len(self.low) == len(self.high) == len(self.shape) > 0:
            given = f"got low={self.low}, high={self.high}, shape={self.shape}"
            raise ValueError(f"low, high and shape need one number for each dimension, {given}")
        sizes = [high - low for low, high in zip(self.low, self.high, strict=True)]
        if not all(0 < size < math.inf for size in sizes):
            raise ValueError(f"a grid needs low < high, both finite, got low={self.low}, high={self.high}")
        if min(self.shape) < 1:
            raise ValueError(f"shape must be at least 1 in each dimension, got {self.shape}")
        self.num_cells = math.prod(self.shape)
        if self.num_cells > _MAX_CELLS:
            raise ValueError(
                f"a grid has at most {_MAX_CELLS} cells, got {self.num_cells} of shape {self.shape}"
            )
        self.cell_size = tuple(size / n for size, n in zip(sizes, self.shape, strict=True))
        self._warned = not warn

    @property
    def axes(self) -> list[Tensor]:
        """Centers of the cells along each dimension, float64."""
        along = zip(self.low, self.cell_size, self.shape, strict=True)
        return [low + size * (torch.arange(n, dtype=torch.float64) + 0.5) for low, size, n in along]

    @property
    def centers(self) -> Tensor:
        """Centers of all cells, [cells, d] of float64."""
        return torch.stack(torch.meshgrid(*self.axes, indexing="ij"), -1).reshape(self.num_cells, -1)

    def cell(self, goals: Tensor) -> Tensor:
        """Returns the cell [...] of int64 of each goal [..., d]; the last dimension varies fastest.

        Goals outside are counted in the cell at the edge. The first time that a goal is farther outside than
        a cell is wide, a warning names it (unless ``warn`` is False).

        Raises:
            ValueError: goals have another width, or are not finite.
        """
        if goals.shape[-1] != len(self.shape):
            raise ValueError(f"the grid has {len(self.shape)} dimensions, got goals of {goals.shape[-1]}")
        check_finite({"goals": goals})
        index = torch.zeros(goals.shape[:-1], dtype=torch.int64, device=goals.device)
        for x, n in self._along(goals):
            if not self._warned and x.numel() > 0:
                least, most = x.aminmax()
                if not ((least >= -1) & (most <= n + 1)):
                    self._warn(goals.detach().reshape(-1, len(self.shape)))
            index.mul_(n).add_(x.clamp_(0, n - 1).long())
        return index

    def _along(self, goals: Tensor) -> Iterator[tuple[Tensor, int]]:
        """Yields for each dimension the position [...] of goals, in cells, and the number of cells."""
        for i, (low, size, n) in enumerate(zip(self.low, self.cell_size, self.shape, strict=True)):
            yield (goals[..., i] - low) / size, n

    def _warn(self, goals: Tensor) -> None:
        self._warned = True
        near = torch.stack([(x >= -1) & (x <= n + 1) for x, n in self._along(goals)]).all(0)
        goal = goals[near.int().argmin()].tolist()
        warnings.warn(
            f"goal {goal} lies outside the grid's box, low={self.low}, high={self.high}; "
            "such goals are counted in the cells at its edge (this warning appears once)",
            stacklevel=3,
        )


def box_target(grid: GoalGrid, low: Numbers, high: Numbers, sigma: Numbers, *, name: str = "") -> Tensor:
    """Computes the target q* for goals uniform in a box, in closed form (thesis, equations 4.3, 4.7).

    The integral over a box is a product of differences of the normal distribution function. If
    sigma is so small that every cell's mass underflows, the cells nearest to the box get all the mass.

    Args:
        grid: grid of cells over all virtual goals.
        low, high: d numbers each, corners of the box of real goals.
        sigma: standard deviation of the Gaussian kernel, in the unit of the goals; one number, or d of them.

    Keyword Args:
        name: name of the task or stage; error messages begin with it.

    Returns:
        q* [cells], float64, with a sum of 1.

    Raises:
        ValueError: the box has no volume, or sigma is not positive and finite.

    Example:
        >>> grid = GoalGrid(0.0, 3.0, [3])
        >>> box_target(grid, 0.5, 1.5, 1.0)  # 0.3413, 0.3413 and 0.1359, normalized
        tensor([0.4170, 0.4170, 0.1660], dtype=torch.float64)
    """
    start, end, label = _floats(low), _floats(high), f"{name}: " if name else ""
    sized = len(start) == len(end) == len(grid.shape)
    if not sized or not all(0 < b - a < math.inf for a, b in zip(start, end, strict=True)):
        raise ValueError(
            f"{label}the box of goals needs a volume: low < high, both finite, in each of the grid's "
            f"{len(grid.shape)} dimensions, got low={start}, high={end}"
        )
    along = zip(grid.axes, start, end, _sigmas(grid, sigma, label), strict=True)
    return reduce(lambda q, p: torch.outer(q, p).flatten(), [_log_mass(*axis).softmax(0) for axis in along])


def _log_mass(x: Tensor, low: float, high: float, sigma: float) -> Tensor:
    """Returns the log of a normal kernel's integral over [low, high], around each x [n], up to a constant.

    The factor exp(-near^2 / 2), where near is the distance to the box, would underflow, so only its logarithm
    is added.
    """
    left, right, width = (x - low) / sigma, (high - x) / sigma, (high - low) / sigma
    near = (-torch.minimum(left, right)).clamp_min(0)
    far, root = near + width, math.sqrt(2)
    inside = torch.erf(left / root) + torch.erf(right / root)
    outside = torch.special.erfcx(near / root) - torch.special.erfcx(far / root) * torch.exp(
        -width * (near + far) / 2
    )
    # Over a thin box, the integral is the width times the kernel at the middle.
    thin = math.sqrt(2 / math.pi) * width * torch.exp(-width * (near + width / 4) / 2)
    outside = torch.where(width * (1 + near) < _THIN, thin, outside)
    mass = torch.where(near > 0, outside, inside).clamp_min(torch.finfo(x.dtype).tiny)
    return mass.log() - near.square() / 2


def _sigmas(grid: GoalGrid, sigma: Numbers, label: str = "") -> list[float]:
    sigmas, d = _floats(sigma), len(grid.shape)
    if len(sigmas) not in (1, d) or not all(0 < s < math.inf for s in sigmas):
        raise ValueError(f"{label}sigma must be positive and finite, a scalar or of length {d}, got {sigma}")
    # Beyond these bounds sigma hardly changes q* (one cell, or uniform), and squares would overflow.
    dimensions = zip(sigmas * d if len(sigmas) == 1 else sigmas, grid.cell_size, grid.shape, strict=True)
    return [min(max(s, 1e-12 * size), 1e12 * size * n) for s, size, n in dimensions]


def sampled_target(grid: GoalGrid, samples: Tensor, sigma: Numbers) -> Tensor:
    """Estimates the target q* from samples of any distribution (thesis, equations 4.2, 4.7).

    Args:
        grid: grid of cells over all virtual goals.
        samples: [n, d] real goals.
        sigma: standard deviation of the Gaussian kernel, in the unit of the goals; one number, or d of them.

    Returns:
        q* [cells], float64, with a sum of 1; its error shrinks as 1 / sqrt(n).

    Raises:
        ValueError: there are no samples, some are not finite or of another shape, or sigma is not positive.

    Example:
        >>> sampled_target(GoalGrid(0.0, 3.0, [3]), torch.tensor([[1.5]]), 1.0)
        tensor([0.2741, 0.4519, 0.2741], dtype=torch.float64)
    """
    d = len(grid.shape)
    if samples.ndim != 2 or samples.shape[1] != d or len(samples) == 0 or not samples.isfinite().all():
        raise ValueError(f"samples must be finite, [n, {d}] with n > 0, got a shape of {list(samples.shape)}")
    scale = torch.tensor(_sigmas(grid, sigma), dtype=torch.float64)
    centers, points = grid.centers / scale, samples.detach().cpu().double() / scale
    total = torch.full((grid.num_cells,), -math.inf, dtype=torch.float64)
    for part in points.split(max(1, _CHUNK // grid.num_cells)):
        pairs = zip(centers.unbind(1), part.unbind(1), strict=True)
        squares = reduce(torch.add, [(c.unsqueeze(1) - p).square() for c, p in pairs])
        total = torch.logaddexp(total, (-squares / 2).logsumexp(1))
    return total.softmax(0)


def kl_divergence(q: Tensor, q_star: Tensor) -> Tensor:
    """KL(q || q*) in nats, with 0 log 0 = 0.

    It is infinite if q* is 0 in a cell in which q is not (also if q* only underflowed there), and never NaN.
    To keep it finite, pass ``q_star.clamp_min(...)``.

    Args:
        q, q_star: [..., cells], each sums to 1.

    Returns:
        Divergences [...].

    Example:
        >>> kl_divergence(torch.tensor([0.5, 0.5, 0.0]), torch.tensor([0.25, 0.25, 0.5]))
        tensor(0.6931)
    """
    return (torch.xlogy(q, q) - torch.xlogy(q, q_star)).sum(-1).clamp_min(0)  # rounding may make it negative
