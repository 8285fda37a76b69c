"""Free balls in many worlds at once: one Chipmunk space in which world k stands at an offset.

This is the only file that knows pymunk. What is held, caught or thrown is decided elsewhere.
"""

from __future__ import annotations

import math

import numpy as np
import pymunk
import pymunk.batch
import torch
from torch import Tensor

from torchrl_her_envs.throwing.tasks import WorldConfig

_FIELDS = pymunk.batch.BodyFields.POSITION | pymunk.batch.BodyFields.VELOCITY
_BORDER = 0.5  # meters: half the thickness of the screen's sides, which lie outside of it
_CELL = 4.0  # meters, of the spatial hash: measured best from 1 to 1024 worlds
_SLOP = 1e-3  # meters that a ball may sink into a surface; Chipmunk's default, 0.1, is meant for pixels
_SKIN = _SLOP / 2  # surfaces stand out by this: a ball put against one touches it, whatever the rounding
_ITERATIONS = 4  # of the solver: a ball touches at most a side and a corner at once


class BallPhysics:
    """Flight, bounces and friction of one ball in each of ``num_worlds`` worlds.

    A bounce keeps ``world.bounce`` of the normal speed; along the surface friction slows the ball,
    which slides and never rolls (its moment of inertia is infinite).

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
        pitch = world.size + 4 * _BORDER
        columns = math.ceil(math.sqrt(num_worlds))  # a square keeps the offsets, and their rounding, small
        index = np.arange(num_worlds)
        self._offset = np.stack((index % columns, index // columns), -1) * pitch
        self._space = self._build(num_worlds, world, wall)
        # pymunk lists the space's static body behind the balls: the last row is that one's, and stays 0
        self._state = np.zeros((num_worlds + 1, 4))
        self._buffer = pymunk.batch.Buffer()
        self._parked = self._park(world)
        self._parked_buffer = pymunk.batch.Buffer()
        self._parked_buffer.set_float_buf(self._parked)
        self._settled = np.full((num_worlds, 4), np.nan)  # a state of each ball that a step leaves unchanged

    def step(self, position: Tensor, velocity: Tensor, free: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Lets balls move for one time step.

        Args:
            position: [num_worlds, 2] float64, meters within the world.
            velocity: [num_worlds, 2] float64, meters a second.
            free: [num_worlds] of bool, which of them move; None for all.

        Returns:
            The new positions and velocities; those of the other balls as they were.
        """
        before = np.concatenate((position.numpy(), velocity.numpy()), -1)
        # A step depends on nothing but the state: if it left a ball unchanged once, it will do so again.
        moving = (before != self._settled).any(-1, keepdims=True)
        if free is not None:
            moving &= free.numpy()[:, None]
        if not moving.any():
            return position.clone(), velocity.clone()
        after = np.where(moving, self._simulate(before, moving), before)
        np.copyto(
            self._settled, np.where((after == before).all(-1, keepdims=True), before, np.nan), where=moving
        )
        return torch.from_numpy(after[:, :2]), torch.from_numpy(after[:, 2:])

    def _simulate(self, before: np.ndarray, moving: np.ndarray) -> np.ndarray:
        """The states [num_worlds, 4] after a time step; balls that do not move are parked meanwhile."""
        pymunk.batch.set_space_bodies(self._space, _FIELDS, self._parked_buffer)
        self._space.step(self._substep)  # forgets the step before, see _park
        balls = self._state[:-1]
        balls[:] = before
        balls[:, :2] += self._offset
        np.copyto(balls, self._parked[:-1], where=~moving)
        self._buffer.set_float_buf(self._state)
        pymunk.batch.set_space_bodies(self._space, _FIELDS, self._buffer)
        for _ in range(self._substeps):
            self._space.step(self._substep)
        result = pymunk.batch.Buffer()
        pymunk.batch.get_space_bodies(self._space, _FIELDS, result)
        state = np.frombuffer(result.float_buf()).reshape(-1, 4)[:-1].copy()
        state[:, :2] -= self._offset
        return state

    def _park(self, world: WorldConfig) -> np.ndarray:
        """All balls at rest where they touch nothing, between the left side and the wall.

        A body keeps its old contacts, and the push that still moves it out of a surface, for one substep
        more. Nobody can read or write these, so all balls spend a substep here before each step: then
        position and velocity are the whole state of a ball.
        """
        parked = np.zeros_like(self._state)
        middle = (world.wall_x - world.wall_thickness / 2) / 2
        parked[:-1, :2] = self._offset + np.array([middle, 0.5]) * world.size
        return parked

    def _build(self, num_worlds: int, world: WorldConfig, wall: bool) -> pymunk.Space:
        space = pymunk.Space()
        space.gravity = (0.0, -world.gravity)
        space.iterations = _ITERATIONS
        space.collision_slop = _SLOP
        space.collision_persistence = 1  # with 0, contacts are dropped before they act: nothing collides
        space.use_spatial_hash(_CELL, 10 * num_worlds)
        for offset in self._offset:
            space.add(*self._sides(space.static_body, offset, world, wall))
        for _ in range(num_worlds):
            body = pymunk.Body(world.ball_mass, float("inf"))
            ball = pymunk.Circle(body, world.ball_radius * world.size)
            ball.elasticity, ball.friction = world.bounce, world.friction
            space.add(body, ball)
        return space

    @staticmethod
    def _sides(body: pymunk.Body, offset: np.ndarray, world: WorldConfig, wall: bool) -> list[pymunk.Shape]:
        """The four sides of one world, and its wall."""
        low, high = offset - _BORDER, offset + world.size + _BORDER
        corners = [(low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1])]
        shapes: list[pymunk.Shape] = [
            pymunk.Segment(body, corners[i], corners[(i + 1) % 4], _BORDER + _SKIN) for i in range(4)
        ]
        if wall:
            left = offset[0] + (world.wall_x - world.wall_thickness / 2) * world.size
            right = left + world.wall_thickness * world.size
            top = offset[1] + world.wall_height * world.size
            outline = [(left, offset[1]), (right, offset[1]), (right, top), (left, top)]
            shapes.append(pymunk.Poly(body, outline, radius=_SKIN))
        for shape in shapes:
            shape.elasticity = shape.friction = 1.0  # Chipmunk multiplies the two surfaces' values
        return shapes
