"""Distributions from which the goals of a task are drawn."""

from __future__ import annotations

import math
from itertools import product
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from torchrl_her_envs.throwing.arrays import Array, functions_of


class GoalDistribution(Protocol):
    """A distribution of points with a bounding box, all in one coordinate system.

    ``low`` and ``high`` are the corners of the (smallest) box around it, ``is_box`` is whether
    the distribution is uniform over that box, ``from_uniform`` maps [..., 2] numbers in [0, 1) to
    points (an array to an array, a tensor to a tensor), ``sample`` draws [n, 2] points, and ``scaled`` is
    the same distribution in coordinates ``factor * x + shift``.
    """

    low: Tensor
    high: Tensor
    is_box: bool

    def from_uniform(self, u: Array) -> Array: ...

    def sample(self, n: int, *, generator: torch.Generator | None = None) -> Tensor: ...

    def scaled(self, factor: float, shift: float) -> GoalDistribution: ...


class _Sampled:
    def from_uniform(self, u: Array) -> Array:
        raise NotImplementedError

    def sample(self, n: int, *, generator: torch.Generator | None = None) -> Tensor:
        """Draws [n, 2] points (float64)."""
        return self.from_uniform(torch.rand(n, 2, dtype=torch.float64, generator=generator))


class BoxGoals(_Sampled):
    """Uniform distribution over an axis-aligned box.

    Args:
        low: left and bottom coordinate.
        high: right and top coordinate; equal to ``low`` in a direction without extent.

    Raises:
        ValueError: ``high`` is below ``low``.

    Example:
        >>> goals = BoxGoals((0.0, 0.0), (1.0, 2.0))
        >>> goals.from_uniform(torch.tensor([0.5, 0.5]))
        tensor([0.5000, 1.0000], dtype=torch.float64)
    """

    is_box = True

    def __init__(self, low: tuple[float, float], high: tuple[float, float]) -> None:
        self.low = torch.tensor(low, dtype=torch.float64)
        self.high = torch.tensor(high, dtype=torch.float64)
        if (self.high < self.low).any():
            raise ValueError(f"a box needs low <= high, got low={low}, high={high}")
        self._extent = self.high - self.low

    def from_uniform(self, u: Array) -> Array:
        return _beside(u, self.low) + u * _beside(u, self._extent)

    def scaled(self, factor: float, shift: float) -> BoxGoals:
        low, high = (self.low * factor + shift).tolist(), (self.high * factor + shift).tolist()
        return BoxGoals((low[0], low[1]), (high[0], high[1]))


class SectorGoals(_Sampled):
    """Distribution of points around a center, with uniform angle and radius (starts of the robot's ball).

    Args:
        center: the point from which angle and radius are measured.
        angle: range in degrees, counter-clockwise from the x axis.
        radius: range of distances from the center.
    """

    is_box = False

    def __init__(
        self, center: tuple[float, float], *, angle: tuple[float, float], radius: tuple[float, float]
    ) -> None:
        self.center = torch.tensor(center, dtype=torch.float64)
        self.angle = angle
        self.radius = radius
        # A sector touches its box at its corners, or straight left, right, above or below the center.
        straight = [90.0 * k for k in range(math.ceil(angle[0] / 90.0), math.floor(angle[1] / 90.0) + 1)]
        touching = torch.tensor(list(product((*angle, *straight), radius)), dtype=torch.float64)
        edge = self._point(touching[:, :1], touching[:, 1:])
        self.low, self.high = edge.amin(0), edge.amax(0)

    def from_uniform(self, u: Array) -> Array:
        angle = self.angle[0] + u[..., :1] * (self.angle[1] - self.angle[0])
        return self._point(angle, self.radius[0] + u[..., 1:] * (self.radius[1] - self.radius[0]))

    def _point(self, angle: Array, radius: Array) -> Array:
        xp = functions_of(angle)
        turn = xp.deg2rad(angle)
        return _beside(angle, self.center) + radius * xp.concatenate((xp.cos(turn), xp.sin(turn)), -1)

    def scaled(self, factor: float, shift: float) -> SectorGoals:
        x, y = (self.center * factor + shift).tolist()
        return SectorGoals(
            (x, y), angle=self.angle, radius=(self.radius[0] * factor, self.radius[1] * factor)
        )


def _beside(u: Array, constant: Tensor) -> Array:
    """Returns a float64 constant as an array if ``u`` is one, else as a tensor."""
    return constant.numpy() if isinstance(u, np.ndarray) else constant
