"""Base class of all IBS weights, with their options and the schedule of the kernel's sigma."""

from __future__ import annotations

import math
from typing import Any

from torchrl_her.goals.weights import GoalWeights


class InstructiveWeights(GoalWeights):
    """Base class of IBS weights: instructiveness max(q* - q, floor), with a kernel whose sigma shrinks.

    Sigma starts larger and shrinks at each :meth:`step` down to its final value. Emptying the buffer
    (``clear``) forgets q but not sigma; :meth:`restart` sets sigma back to its first value, as at the change
    of a curriculum's stage. In stages that are not instructive ``is_uniform`` is True, so that no weights are
    computed.

    Keyword Args:
        sigma: the final standard deviation of the kernel.
        start_factor: the first sigma divided by the final one; at least 1.
        decay: factor of the covariance in each step, in (0, 1]; 1 never shrinks it.
        floor: the least weight of a goal. If it is 0, a goal at which q has reached q* is no longer drawn.
        subtract: False for the weights q* alone, without q and floor (the sequential architecture).

    Attributes:
        sigma: present standard deviation of the kernel.
        final_sigma: standard deviation at the end of the schedule.

    Raises:
        ValueError: an option is out of its range.

    Example:
        >>> weights = InstructiveWeights(sigma=0.2)
        >>> weights.step()
        >>> round(weights.sigma**2, 3)  # 0.6 squared, times 0.9
        0.324
    """

    is_uniform = False
    sigma: float

    def __init__(
        self,
        *,
        sigma: float,
        start_factor: float = 3.0,
        decay: float = 0.9,
        floor: float = 0.002,
        subtract: bool = True,
    ) -> None:
        if not 0 < sigma < math.inf:
            raise ValueError(f"sigma must be positive and finite, got {sigma}")
        if not 1 <= start_factor < math.inf:
            raise ValueError(f"start_factor must be at least 1 and finite, got {start_factor}")
        if not 0 < decay <= 1:
            raise ValueError(f"decay must be above 0 and at most 1, got {decay}")
        if not 0 <= floor < math.inf:
            raise ValueError(f"floor must be at least 0 and finite, got {floor}")
        self.final_sigma, self.start_factor, self.decay = sigma, start_factor, decay
        self.floor, self.subtract = floor, subtract
        self.restart()

    @property
    def divergence(self) -> float:
        """KL(q || q*) in nats at the final and not the present sigma; NaN before the first write."""
        raise NotImplementedError

    def step(self) -> None:
        """Shrinks sigma; to be called at the end of each epoch."""
        self._set_sigma(max(self.final_sigma, self.sigma * math.sqrt(self.decay)))

    def restart(self) -> None:
        """Sets sigma back to its first value."""
        self._set_sigma(self.final_sigma * self.start_factor)

    def state_dict(self) -> dict[str, Any]:
        return {**super().state_dict(), "sigma": self.sigma}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        super().load_state_dict(state)
        self._set_sigma(state["sigma"])

    def _set_sigma(self, sigma: float) -> None:
        """Hook for subclasses that is called whenever sigma changes."""
        self.sigma = sigma
