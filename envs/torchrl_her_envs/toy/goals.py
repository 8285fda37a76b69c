"""Goals on the points of a regular lattice."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


class LatticeGoals:
    """Uniform distribution over points of a regular lattice; a :class:`~torchrl_her_envs.GoalDistribution`.

    Args:
        low: [g], the least coordinates.
        high: [g], the greatest coordinates.
        count: points along each coordinate; 1 if ``low`` and ``high`` are the same point.

    Raises:
        ValueError: ``high`` is below ``low``, or ``count`` is below 1 or too few for both ends.

    Example:
        >>> goals = LatticeGoals([0.0], [1.0], count=3)
        >>> goals.from_uniform(torch.tensor([[0.0], [0.5], [0.9]])).flatten().tolist()
        [0.0, 0.5, 1.0]
    """

    is_box = False  # goals are lattice points of a box, not the whole box

    def __init__(self, low: Sequence[float], high: Sequence[float], *, count: int) -> None:
        self.low = torch.tensor(low, dtype=torch.float64)
        self.high = torch.tensor(high, dtype=torch.float64)
        if self.low.shape != self.high.shape or (self.high < self.low).any():
            raise ValueError(f"a lattice needs low <= high, got low={low}, high={high}")
        least = 2 if (self.high > self.low).any() else 1
        if count < least:
            raise ValueError(f"count must be at least {least} from low={low} to high={high}, got {count}")
        self.count = count

    def from_uniform(self, u: Tensor) -> Tensor:
        """Maps [..., g] numbers in [0, 1) to points of the lattice."""
        steps = (u * self.count).floor().clamp(max=self.count - 1)  # float32 may round up to count
        return self.low + steps * (self.high - self.low) / max(self.count - 1, 1)

    def sample(self, n: int, *, generator: torch.Generator | None = None) -> Tensor:
        """Draws [n, g] points (float64)."""
        return self.from_uniform(torch.rand(n, len(self.low), dtype=torch.float64, generator=generator))

    def scaled(self, factor: float, shift: float) -> LatticeGoals:
        """Returns the lattice in coordinates ``factor * x + shift``, with a positive factor."""
        low, high = (self.low * factor + shift).tolist(), (self.high * factor + shift).tolist()
        return LatticeGoals(low, high, count=self.count)
