"""Interface of the body that the agent moves: a hand or an arm."""

from __future__ import annotations

from typing import Protocol

from torchrl_her_envs.throwing.arrays import Array


class Effector(Protocol):
    """A hand or an arm: pure functions of its joints (for a hand, its position), in meters.

    The functions take NumPy arrays or tensors and return the same type. ``move_one`` and ``grip_one`` take
    the joints of a single world as plain numbers, which is several times as fast as arrays of one.

    ``num_joints`` is the number of joints, ``action_speed`` the speed at an action of 1,
    ``reach`` the box around what the grip can reach: left, bottom, right and top, in fractions of the
    screen. ``shown`` names the quantities that the agent observes, in that order: ``cosines`` and ``sines``
    (of all joints), ``grip``, ``joint_velocity``, ``grip_velocity``, ``closed``. ``observation_size`` is the
    number of their entries, and ``grip_index`` the two entries of the grip's position.
    """

    num_joints: int
    action_speed: float
    shown: tuple[str, ...]
    observation_size: int
    reach: tuple[float, float, float, float]
    grip_index: tuple[int, int]

    def sample(self, u: Array) -> Array:
        """Maps numbers in [0, 1) to start positions of the joints, both [..., num_joints]."""
        ...

    def move(self, joints: Array, change: Array) -> Array:
        """Returns the joints after a change of [..., num_joints], kept within their limits."""
        ...

    def move_one(self, joints: list[float], change: list[float]) -> list[float]:
        """Returns the joints of one hand or arm after a change; see :meth:`move`."""
        ...

    def grip(self, joints: Array) -> Array:
        """Returns the position [..., 2] of the grip."""
        ...

    def grip_one(self, joints: list[float]) -> list[float]:
        """Returns the position of the grip of one hand or arm."""
        ...

    def skeleton(self, joints: Array) -> Array:
        """Returns points [..., n, 2] between which lines are drawn, the grip last."""
        ...
