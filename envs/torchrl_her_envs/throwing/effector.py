"""The interface of what the agent moves: a hand or an arm."""

from __future__ import annotations

from typing import Protocol

from torch import Tensor


class Effector(Protocol):
    """A hand or an arm: pure functions of its joints (for a hand, its position), in meters.

    ``num_joints`` is the number of joints, ``action_speed`` the speed that an action of 1 asks for,
    ``observation_size`` the number of entries that :meth:`observe` gives, ``grip_index`` the two of them
    that are the grip's position, and ``reach`` the box around what the grip can reach: left, bottom,
    right and top, in fractions of the screen.
    """

    num_joints: int
    action_speed: float
    observation_size: int
    reach: tuple[float, float, float, float]
    grip_index: tuple[int, int]

    def sample(self, u: Tensor) -> Tensor:
        """Start positions of the joints, [..., num_joints], from as many numbers in [0, 1)."""
        ...

    def move(self, joints: Tensor, change: Tensor) -> Tensor:
        """The joints after a change of [..., num_joints], kept within their limits."""
        ...

    def grip(self, joints: Tensor) -> Tensor:
        """Position [..., 2] of what grips."""
        ...

    def observe(
        self, joints: Tensor, speed: Tensor, grip: Tensor, grip_speed: Tensor, closed: Tensor
    ) -> Tensor:
        """The entries [..., observation_size] that the agent sees of it, from scaled quantities."""
        ...

    def skeleton(self, joints: Tensor) -> Tensor:
        """Points [..., n, 2] to draw lines between, the grip last."""
        ...
