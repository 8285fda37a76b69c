"""What prefers some virtual goals to others."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


class GoalWeights:
    """How useful each achieved goal is as a virtual goal. Subclass it to direct HER.

    The base class weighs all goals alike and remembers nothing.

    Attributes:
        alike: True promises that all weights are equal, which spares the writer their look-up.
    """

    alike: bool = False

    def __call__(self, goals: Tensor) -> Tensor:
        """Weights [...] of at least 0 for goals [..., g]."""
        return goals.new_ones(goals.shape[:-1])

    def update(self, goals: Tensor) -> None:
        """Told of the virtual goals [n, g] that were written."""

    def clear(self) -> None:
        """Told that the buffer was emptied."""

    def state_dict(self) -> dict[str, Any]:
        """Tensors and plain data that :meth:`load_state_dict` takes."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Puts back what :meth:`state_dict` gave."""


def checked_weights(weight: Tensor) -> Tensor:
    """Weights as floating numbers.

    Raises:
        ValueError: some are negative or not finite.
    """
    weight = weight if weight.is_floating_point() else weight.float()
    if weight.numel() > 0:
        least, most = weight.aminmax()
        if not bool((least >= 0) & (most < torch.inf)):  # NaN fails both
            raise ValueError(f"weights of goals must be finite and at least 0, got {least} to {most}")
    return weight
