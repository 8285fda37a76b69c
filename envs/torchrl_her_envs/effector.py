"""What an environment needs to know of the thing that an agent moves."""

from __future__ import annotations

from typing import Protocol

from torch import Tensor


class Effector(Protocol):
    """A hand or an arm: pure functions of its joints (for a hand, its position), in metres.

    ``grip_index`` says where the grip's position stands in what :meth:`observe` gives.
    ``action_speed`` is the speed that an action of 1 asks for, ``max_grip_speed`` scales the shown
    velocity of the grip, and ``goal_box`` is its task's box of goals (fractions of the screen).
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
