"""The time step of a throwing task: who holds the ball, and how hands, arms and balls move.

The same rules serve one world in plain numbers and many worlds in arrays: for one world numbers are several
times as fast, for many worlds arrays.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import numpy as np

from torchrl_her_envs.throwing.arrays import within
from torchrl_her_envs.throwing.effector import Effector
from torchrl_her_envs.throwing.physics import BallPhysics
from torchrl_her_envs.throwing.tasks import WorldConfig


class Bodies(NamedTuple):
    """Everything that a step changes: points [2, N], joints [J, N] and flags [N] of bool.

    For one world, points and joints are lists of 2 and J numbers, and flags are single bools.
    """

    joints: Any
    joint_velocity: Any
    grip: Any
    grip_velocity: Any
    ball: Any
    ball_velocity: Any
    closed: Any
    held: Any
    free: Any


class Kind(Protocol):
    """Protocol of the operations that differ between numbers and arrays."""

    def move(self, joints: Any, action: Any) -> Any:
        """Returns the joints after an action of one step."""
        ...

    def grip(self, joints: Any) -> Any:
        """Returns the position of the grip."""
        ...

    def rate(self, after: Any, before: Any) -> Any:
        """Returns the velocity at which something moved in this step."""
        ...

    def fly(self, ball: Any, velocity: Any, free: Any) -> tuple[Any, Any]:
        """Returns positions and velocities of the balls after one step, in which free ones fly."""
        ...

    def pick(self, condition: Any, one: Any, other: Any) -> Any:
        """Selects one point where a condition holds, the other elsewhere."""
        ...


def take_step(now: Bodies, action: Any, closed: Any, kind: Kind, *, catch: float) -> Bodies:
    """Opens or closes the grips, moves them, lets the free balls fly, and catches.

    Args:
        now: the bodies before the step.
        action: the speeds of the joints, within [-1, 1]: [J, N], or a list.
        closed: whether the grips close: [N] of bool, or a bool.
        kind: the operations on numbers or on arrays.
        catch: distance from a closed grip within which a ball is caught, in meters.
    """
    held, released = now.held & closed, now.held > closed
    # A released ball keeps the velocity that the hand had in the step before.
    velocity = kind.pick(released, now.grip_velocity, now.ball_velocity)
    joints = kind.move(now.joints, action)
    grip = kind.grip(joints)
    joint_velocity = kind.rate(joints, now.joints)
    grip_velocity = joint_velocity if grip is joints else kind.rate(grip, now.grip)
    free = now.free | released
    ball, velocity = kind.fly(now.ball, velocity, free)
    (x, y), (grip_x, grip_y) = ball, grip
    held = held | (closed & within(x - grip_x, y - grip_y, catch))
    return Bodies(
        joints,
        joint_velocity,
        grip,
        grip_velocity,
        kind.pick(held, grip, ball),
        kind.pick(held, grip_velocity, velocity),
        closed,
        held,
        free > held,
    )


def reward_of(achieved: Any) -> Any:
    """Returns 0 where a goal is achieved and -1 elsewhere, from a bool or an array of bool.

    Example:
        >>> reward_of(True), reward_of(False)
        (0.0, -1.0)
    """
    return achieved - 1.0


class Numbers:
    """Operations on one world in plain numbers; ``world`` is its index in the physics."""

    world = 0

    def __init__(self, effector: Effector, physics: BallPhysics, world: WorldConfig) -> None:
        self._effector, self._physics = effector, physics
        self._step, self._reach = world.time_step, effector.action_speed * world.time_step

    def move(self, joints: list[float], action: list[float]) -> list[float]:
        return self._effector.move_one(joints, [part * self._reach for part in action])

    def grip(self, joints: list[float]) -> list[float]:
        return self._effector.grip_one(joints)

    def rate(self, after: list[float], before: list[float]) -> list[float]:
        return [(to - at) / self._step for to, at in zip(after, before, strict=True)]

    def fly(self, ball: list[float], velocity: list[float], free: bool) -> tuple[list[float], list[float]]:
        if not free:
            return ball, velocity
        after = self._physics.advance_one(self.world, ball + velocity)
        return after[:2], after[2:]

    def pick(self, condition: bool, one: list[float], other: list[float]) -> list[float]:
        return one if condition else other


class Arrays:
    """Operations on all worlds at once, in arrays."""

    def __init__(self, effector: Effector, physics: BallPhysics, world: WorldConfig) -> None:
        self._effector, self._physics = effector, physics
        self._step, self._reach = world.time_step, effector.action_speed * world.time_step

    def move(self, joints: np.ndarray, action: np.ndarray) -> np.ndarray:
        return self._effector.move(joints.T, (action * self._reach).T).T

    def grip(self, joints: np.ndarray) -> np.ndarray:
        moved = joints.T
        grip = self._effector.grip(moved)
        return joints if grip is moved else grip.T

    def rate(self, after: np.ndarray, before: np.ndarray) -> np.ndarray:
        velocity = after - before
        velocity /= self._step
        return velocity

    def fly(self, ball: np.ndarray, velocity: np.ndarray, free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        balls = np.concatenate((ball, velocity))
        self._physics.advance(balls, free)
        return balls[:2], balls[2:]

    def pick(self, condition: np.ndarray, one: np.ndarray, other: np.ndarray) -> np.ndarray:
        return np.where(condition, one, other)
