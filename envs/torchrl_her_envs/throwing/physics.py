"""Free balls in many worlds at once: flight by array code, contacts by one Chipmunk space (pymunk).

pymunk simulates a ball's step only if the ball may touch something in it: 3 to 12 % of the steps with random
actions on the throwing tasks, none on `robot_v1`. Array code adds up free flight in the order that Chipmunk
has, so its results equal Chipmunk's to the last bit. Only this file imports pymunk; other files decide which
balls are held, caught or thrown.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pymunk
import pymunk.batch
import torch
from torch import Tensor

from torchrl_her_envs.throwing.tasks import WorldConfig

_FIELDS = pymunk.batch.BodyFields.POSITION | pymunk.batch.BodyFields.VELOCITY
_BORDER = 0.5  # half the thickness in meters of the screen's sides, which lie outside of the screen
_CELL = 1.0  # side in meters of a cell of the spatial hash; larger cells compare more balls
_CELLS = 100  # number of cells of the spatial hash
_SLOP = 1e-3  # meters that a ball may sink into a surface; Chipmunk's default, 0.1, is meant for pixels
_SKIN = _SLOP / 2  # meters added to surfaces, so that a ball put against one touches it despite rounding
_ITERATIONS = 4  # number of iterations of the solver: a ball touches at most a side and a corner at once
_MOST = 64  # largest number of balls in the space: each is compared with all nearby ones
_APART = 4.0  # meters between the edges of parked balls, and between the right side and the first ball
_PATIENCE = 64  # number of steps after which unused balls are removed
_FEW = 12  # number of balls up to which plain numbers are faster than arrays


class BallPhysics:
    """Flight, bounces and friction of one ball in each of ``num_worlds`` worlds.

    A bounce keeps ``world.bounce`` of the normal speed; along the surface friction slows the ball,
    which slides and never rolls (its moment of inertia is infinite).

    All worlds share one Chipmunk space and its coordinates, and their balls do not collide. So a ball's path
    depends on nothing but the ball's position and velocity, to the last bit, whichever other worlds there
    are. Balls that touch nothing within a step need no space: a few sums give the same result as
    Chipmunk.

    Args:
        num_worlds: number of worlds, at least 1.
        world: the constants of the world.
        wall: whether a wall stands in the middle.

    Example:
        >>> physics = BallPhysics(1, WorldConfig(), wall=False)
        >>> position, velocity = torch.tensor([[3.0, 4.0]]).double(), torch.zeros(1, 2).double()
        >>> position, velocity = physics.step(position, velocity)
        >>> velocity.tolist()  # fell for 0.04 s at 10 m/s^2
        [[0.0, -0.4]]
    """

    def __init__(self, num_worlds: int, world: WorldConfig, *, wall: bool) -> None:
        self._substep = world.time_step / world.substeps
        self._substeps = world.substeps
        self._step = world.time_step
        self._pull = world.gravity * self._substep
        self._limits = _Limits(world, wall=wall)
        self._settled = np.full((4, num_worlds), np.nan)  # last state of each ball that a step left unchanged
        self._space = _Space(world, wall=wall)

    def step(self, position: Tensor, velocity: Tensor, free: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Moves free balls by one time step.

        Args:
            position: [num_worlds, 2] float64, meters within the world.
            velocity: [num_worlds, 2] float64, meters a second.
            free: [num_worlds], mask of the balls that move; None for all.

        Returns:
            The new positions and velocities; those of all other balls are unchanged.
        """
        balls = np.concatenate((position.numpy().T, velocity.numpy().T))
        self.advance(balls, np.ones(len(position), np.bool_) if free is None else free.numpy())
        after = torch.from_numpy(balls.T.copy())
        return after[:, :2], after[:, 2:]

    def advance(self, balls: np.ndarray, free: np.ndarray) -> None:
        """Moves free balls by one time step, in place.

        Args:
            balls: [4, num_worlds] float64: x, y and their velocities, in meters within the world.
            free: [num_worlds], mask of the balls that move.
        """
        # A step depends on nothing but the state: if it left a ball unchanged once, it will do so again.
        moves = np.logical_or.reduce(balls != self._settled, 0)
        moves &= free
        index = moves.nonzero()[0]
        if not len(index):
            return
        before = balls[:, index]
        if len(index) <= _FEW:
            flights = [self._fly(*ball) for ball in before.T.tolist()]
            *after, touches = (np.array(entry) for entry in zip(*flights, strict=True))
        else:
            *after, touches = self._fly(*before)
        balls[:, index] = after
        if touches.any():
            near = touches.nonzero()[0]
            balls[:, index[near]] = self._bounce(index[near], before[:, near])

    def advance_one(self, world: int, ball: list[float]) -> list[float]:
        """Moves one free ball by one time step, as :meth:`advance` does.

        Args:
            world: the index of its world.
            ball: x and y of the ball, then its velocity in both directions.
        """
        if ball == self._settled[:, world].tolist():
            return ball
        *after, touches = self._fly(*ball)
        if touches:
            return self._bounce(np.array([world]), np.array(ball)[:, None])[:, 0].tolist()
        return after

    def _fly(self, x: Any, y: Any, speed_x: Any, speed_y: Any) -> tuple[Any, Any, Any, Any, Any]:
        """Computes a time step without contacts, on numbers or arrays, with Chipmunk's sums in its order.

        Returns:
            x, y, their velocities, and whether the ball may touch something on its way.
        """
        to_x, to_y, falls, across = x, y, speed_y, speed_x * self._substep
        for _ in range(self._substeps):
            to_x = to_x + across
            to_y = to_y + falls * self._substep
            falls = falls - self._pull
        # Contacts are looked for at the end of each substep. Without gravity the ball would come to
        # ``straight``; its path lies between the lines to there and to its true end.
        straight = y + speed_y * self._step
        low, high = (to_y, straight) if self._pull >= 0 else (straight, to_y)
        return to_x, to_y, speed_x, falls, self._limits.reached((x, to_x), (y, low), (y, high))

    def _bounce(self, worlds: np.ndarray, before: np.ndarray) -> np.ndarray:
        """Simulates a time step of the balls of some worlds [K] in the space, from and to states [4, K]."""
        after = np.empty_like(before)
        for start in range(0, len(worlds), _MOST):
            part = slice(start, start + _MOST)
            after[:, part] = self._space.simulate(before[:, part], self._substep, self._substeps)
        rests = np.logical_and.reduce(after == before, 0)
        if rests.any():
            self._settled[:, worlds[rests]] = before[:, rests]
        return after


class _Limits:
    """Coordinates beyond which a ball may touch a side of the screen or the wall."""

    def __init__(self, world: WorldConfig, *, wall: bool) -> None:
        reach = world.ball_radius * world.size + 2 * _SKIN  # one more skin than needed, because of rounding
        self._least, self._most = reach, world.size - reach
        self._wall: tuple[float, float, float] | None = None
        if wall:
            middle, half = world.wall_x * world.size, world.wall_thickness / 2 * world.size + reach
            self._wall = (middle - half, middle + half, world.wall_height * world.size + reach)

    def reached(self, xs: tuple[Any, Any], lows: tuple[Any, Any], highs: tuple[Any, Any]) -> Any:
        """Returns whether a ball within a box, in numbers or arrays, may touch something.

        Args:
            xs: left and right side of the box, in any order.
            lows: two heights, the lower of which is the bottom of the box.
            highs: two heights, the higher of which is the top of the box.
        """
        (x, to_x), (y, low), (_, high) = xs, lows, highs
        least, most = self._least, self._most
        touches = (x < least) | (to_x < least) | (y < least) | (low < least)
        touches = touches | (x > most) | (to_x > most) | (y > most) | (high > most)
        if self._wall is not None:
            left, right, top = self._wall
            beside = ((x > left) | (to_x > left)) & ((x < right) | (to_x < right))
            touches = touches | (beside & ((y < top) | (low < top)))
        return touches


class _Space:
    """Chipmunk space with sides and wall, shared by all worlds whose balls may touch something in a step.

    Args:
        world: the constants of the world.
        wall: whether a wall stands in the middle.
    """

    def __init__(self, world: WorldConfig, *, wall: bool) -> None:
        self._world = world
        self._space = pymunk.Space()
        self._space.gravity = (0.0, -world.gravity)
        self._space.iterations = _ITERATIONS
        self._space.collision_slop = _SLOP
        self._space.collision_persistence = 1  # with 0, contacts are dropped before they act
        self._space.use_spatial_hash(_CELL, _CELLS)
        self._space.add(*_sides(self._space.static_body, world, wall))
        self._result, self._buffer, self._parked_buffer = (pymunk.batch.Buffer() for _ in range(3))
        self._balls: list[tuple[pymunk.Body, pymunk.Shape]] = []
        self._calls = self._needed = 0
        self._resize(1)

    def simulate(self, before: np.ndarray, substep: float, substeps: int) -> np.ndarray:
        """Simulates some substeps of balls in states [4, K], and returns their new states."""
        count = before.shape[1]
        self._make_room(count)
        space, state = self._space, self._state
        pymunk.batch.set_space_bodies(space, _FIELDS, self._parked_buffer)
        space.step(substep)  # drops contacts of the step before, see _resize
        state[:count] = before.T
        state[count:] = self._parked[count:]
        pymunk.batch.set_space_bodies(space, _FIELDS, self._buffer)
        for _ in range(substeps):
            space.step(substep)
        self._result.clear()
        pymunk.batch.get_space_bodies(space, _FIELDS, self._result)
        return np.frombuffer(self._result.float_buf()).reshape(-1, 4)[:count].T.copy()

    def _make_room(self, count: int) -> None:
        """Adds balls to the space if there are too few, and now and then removes those not needed."""
        self._calls += 1
        self._needed = max(self._needed, count)
        if count > len(self._balls):
            self._resize(count)
        elif self._calls >= _PATIENCE:
            if self._needed < len(self._balls):
                self._resize(self._needed)
            self._calls = self._needed = 0

    def _resize(self, count: int) -> None:
        """Adds or removes balls up to the given number, and parks them.

        A body keeps its old contacts, and the push that still moves it out of a surface, for one substep
        more. These cannot be read or written. So before each step all balls are parked for a substep, far
        from everything and from each other: then position and velocity are the whole state of a ball.
        """
        world = self._world
        while len(self._balls) > count:
            self._space.remove(*self._balls.pop())
        while len(self._balls) < count:
            body = pymunk.Body(world.ball_mass, float("inf"))
            ball = pymunk.Circle(body, world.ball_radius * world.size)
            ball.elasticity, ball.friction = world.bounce, world.friction
            ball.filter = pymunk.ShapeFilter(group=1)  # balls of different worlds do not collide
            self._space.add(body, ball)
            self._balls.append((body, ball))
        # pymunk lists the space's static body behind the balls: the last row is for that body, and stays 0
        self._parked = np.zeros((count + 1, 4))
        # Parked balls lie beyond the right side, which is 2 * _BORDER thick whatever the size of the world.
        diameter = 2 * world.ball_radius * world.size
        first = world.size + 2 * _BORDER + diameter + _APART
        self._parked[:-1, 0] = first + (diameter + _APART) * np.arange(count)
        self._state = self._parked.copy()
        self._parked_buffer.set_float_buf(self._parked)
        self._buffer.set_float_buf(self._state)


def _sides(body: pymunk.Body, world: WorldConfig, wall: bool) -> list[pymunk.Shape]:
    """Makes the four sides of the screen, and the wall."""
    low, high = -_BORDER, world.size + _BORDER
    corners = [(low, low), (high, low), (high, high), (low, high)]
    shapes: list[pymunk.Shape] = [
        pymunk.Segment(body, corners[i], corners[(i + 1) % 4], _BORDER + _SKIN) for i in range(4)
    ]
    if wall:
        left = (world.wall_x - world.wall_thickness / 2) * world.size
        right = left + world.wall_thickness * world.size
        top = world.wall_height * world.size
        outline = [(left, 0.0), (right, 0.0), (right, top), (left, top)]
        shapes.append(pymunk.Poly(body, outline, radius=_SKIN))
    for shape in shapes:
        shape.elasticity = shape.friction = 1.0  # Chipmunk multiplies the two surfaces' values
    return shapes
