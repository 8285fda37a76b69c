"""The "peer" of ``env_speed.py``: the hand's throwing tasks as an ordinary gymnasium environment.

One pymunk space and plain Python, as one would write it without batching. It follows the same rules as
``torchrl_her_envs`` and takes its constants from there, so that both can be compared step by step, but no
code is shared. The cheaper way is chosen: a held ball moves along without simulation, and Chipmunk finds and
remembers contacts in its default way.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pymunk
from gymnasium import spaces

from torchrl_her_envs import Task, WorldConfig

Observation = dict[str, Any]  # arrays
Point = tuple[float, float]

BORDER = 0.5  # half the thickness of the screen's sides, in meters
SLOP = 1e-3  # meters that a ball may sink into a surface
PARKED = (1.0, 3.0)  # position in meters at which a ball touches nothing


class PeerEnv(gymnasium.Env[Observation, np.ndarray]):
    """One hand, one ball, one black hole.

    Args:
        task: a throwing task of the hand.
        world: the constants of the world.
        dtype: type of observations.
        exact: whether contacts are found in the batched environment's order, which matters at corners, and
            are forgotten after each step. This is slow, so only comparisons of paths use it.

    Raises:
        ValueError: the task is not a throwing task of the hand.
    """

    def __init__(
        self,
        task: Task,
        world: WorldConfig | None = None,
        *,
        dtype: type[np.floating] = np.float32,
        exact: bool = False,
    ) -> None:
        if task.effector != "hand" or not task.throws:
            raise ValueError(f"task must be a throwing task of the hand, got {task.name!r}")
        self.task = task
        self.world = world or WorldConfig()
        self.dtype = dtype
        self.exact = exact
        self.observation_space = spaces.Dict(
            observation=spaces.Box(-np.inf, np.inf, (9,), dtype),
            achieved_goal=spaces.Box(-np.inf, np.inf, (2,), dtype),
            desired_goal=spaces.Box(-np.inf, np.inf, (2,), dtype),
        )
        self.action_space = spaces.Box(-1.0, 1.0, (3,), np.float32)
        self._held = self._closed = False
        self._step = 0
        self._set_constants()
        self._space, self._ball = self._build()

    def _set_constants(self) -> None:
        world = self.world
        self._radius = world.ball_radius * world.size
        self._threshold2 = world.shown(world.hole_radius) ** 2
        self._scale = 2.0 / world.size
        self._wall_left = (world.wall_x - world.wall_thickness / 2) * world.size
        self._high = world.size - self._radius
        self._right = (self._wall_left if self.task.wall else world.wall_x * world.size) - self._radius
        self._reach = world.hand_speed * world.time_step
        self._substep = world.time_step / world.substeps

    # gymnasium

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        super().reset(seed=seed, options=options)
        u = self.np_random.random(6).tolist()
        hand = (self._between(u[0], self._right), self._between(u[1], self._high))
        held = u[2] < {"held": 1.0, "away": 0.0, "mixed": 0.5}[self.task.start]
        ball = hand if held else (self._between(u[3], self._right), self._radius)
        left, bottom, right, top = (2.0 * side - 1.0 for side in self.world.hand_goals)
        goal = (left + u[4] * (right - left), bottom + u[5] * (top - bottom))
        rest = (0.0, 0.0)
        self.place(hand=hand, hand_velocity=rest, ball=ball, ball_velocity=rest, goal=goal, held=held)
        return self._observe(), {}

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        x, y, grip = action.tolist()
        closed = grip > 0.0
        if self._held and not closed:
            self._held = False
            self._ball.velocity = self._hand_velocity  # velocity in the step before
        self._move_hand(x, y)
        if not self._held:
            self._fly()
        if self._held or (closed and self._near()):
            self._held = True
            self._ball.position, self._ball.velocity = self._hand, self._hand_velocity
        self._closed = closed
        self._step += 1
        observation = self._observe()
        terminated = self._achieved()
        truncated = self._step >= self.world.max_steps
        return observation, 0.0 if terminated else -1.0, terminated, truncated, {}

    # The world

    def place(
        self, *, hand: Point, hand_velocity: Point, ball: Point, ball_velocity: Point, goal: Point, held: bool
    ) -> None:
        """Starts an episode in a given state, in meters, with a goal in observed coordinates."""
        self._hand, self._hand_velocity, self._goal = hand, hand_velocity, goal
        self._held = self._closed = held
        self._ball.position, self._ball.velocity = ball, ball_velocity
        self._step = 0

    def _between(self, u: float, high: float) -> float:
        return self._radius + u * (high - self._radius)

    def _move_hand(self, x: float, y: float) -> None:
        old_x, old_y = self._hand
        new_x = min(max(old_x + x * self._reach, self._radius), self._right)
        new_y = min(max(old_y + y * self._reach, self._radius), self._high)
        dt = self.world.time_step
        self._hand = (new_x, new_y)
        self._hand_velocity = ((new_x - old_x) / dt, (new_y - old_y) / dt)

    def _fly(self) -> None:
        if self.exact:
            kept = self._ball.position, self._ball.velocity
            self._ball.position, self._ball.velocity = PARKED, (0.0, 0.0)
            self._space.step(self._substep)
            self._ball.position, self._ball.velocity = kept
        for _ in range(self.world.substeps):
            self._space.step(self._substep)

    def _near(self) -> bool:
        (x, y), (hand_x, hand_y) = self._ball.position, self._hand
        return (x - hand_x) ** 2 + (y - hand_y) ** 2 < self._radius**2

    def _achieved(self) -> bool:
        x, y = self._ball.position
        gap_x, gap_y = x * self._scale - 1.0 - self._goal[0], y * self._scale - 1.0 - self._goal[1]
        return gap_x * gap_x + gap_y * gap_y < self._threshold2

    def _observe(self) -> Observation:
        scale, speed = self._scale, self.world.hand_speed
        (x, y), (vx, vy) = self._hand, self._hand_velocity
        (ball_x, ball_y), (ball_vx, ball_vy) = self._ball.position, self._ball.velocity
        hand = [x * scale - 1.0, y * scale - 1.0, vx / speed, vy / speed, float(self._closed)]
        ball = [ball_x * scale - 1.0, ball_y * scale - 1.0, ball_vx / speed, ball_vy / speed]
        observation = np.array(hand + ball, self.dtype)
        return {
            "observation": observation,
            "achieved_goal": observation[5:7],
            "desired_goal": np.array(self._goal, self.dtype),
        }

    def _build(self) -> tuple[pymunk.Space, pymunk.Body]:
        space = pymunk.Space()
        space.gravity = (0.0, -self.world.gravity)
        space.iterations = 4
        space.collision_slop = SLOP
        space.collision_persistence = 1
        if self.exact:
            space.use_spatial_hash(4.0, 10)
        for shape in self._surfaces(space.static_body):
            shape.elasticity = shape.friction = 1.0
            space.add(shape)
        body = pymunk.Body(self.world.ball_mass, float("inf"))
        ball = pymunk.Circle(body, self._radius)
        ball.elasticity, ball.friction = self.world.bounce, self.world.friction
        space.add(body, ball)
        return space, body

    def _surfaces(self, body: pymunk.Body) -> list[pymunk.Shape]:
        low, high = -BORDER, self.world.size + BORDER
        corners = [(low, low), (high, low), (high, high), (low, high)]
        ends = zip(corners, corners[1:] + corners[:1], strict=True)
        shapes: list[pymunk.Shape] = [pymunk.Segment(body, a, b, BORDER + SLOP / 2) for a, b in ends]
        if self.task.wall:
            left, right = self._wall_left, self._wall_left + self.world.wall_thickness * self.world.size
            top = self.world.wall_height * self.world.size
            outline = [(left, 0.0), (right, 0.0), (right, top), (left, top)]
            shapes.append(pymunk.Poly(body, outline, radius=SLOP / 2))
        return shapes
