"""Weights of goals: which virtual goals are drawn more often than others."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


class GoalWeights:
    """How useful each achieved goal is as a virtual goal. Subclass it for a measure of your own.

    The base class gives all goals the same weight and has no state.

    Attributes:
        alike: True promises that all weights are equal, so that nobody has to look them up.

    Example:
        >>> class PreferRight(GoalWeights):
        ...     def __call__(self, goals):
        ...         return goals[..., 0].clamp_min(0.0)
        >>> PreferRight()(torch.tensor([[-1.0, 0.0], [2.0, 0.0]]))
        tensor([0., 2.])
    """

    alike: bool = False

    def __call__(self, goals: Tensor) -> Tensor:
        """Weights [...] of at least 0 for goals [..., g]."""
        return goals.new_ones(goals.shape[:-1])

    def update(self, goals: Tensor) -> None:
        """Called with the virtual goals [n, g] that were written or sampled."""

    def clear(self) -> None:
        """Called when the writer's buffer was emptied."""

    def state_dict(self) -> dict[str, Any]:
        """Tensors and plain data that :meth:`load_state_dict` takes."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Puts back what :meth:`state_dict` gave."""


def checked_weights(weight: Tensor) -> Tensor:
    """Weights as floating-point numbers.

    Raises:
        ValueError: some are negative or not finite.
    """
    weight = weight if weight.is_floating_point() else weight.float()
    if weight.numel() > 0:
        least, most = weight.aminmax()
        if not bool((least >= 0) & (most < torch.inf)):  # NaN fails both
            raise ValueError(f"weights of goals must be finite and at least 0, got {least} to {most}")
    return weight
