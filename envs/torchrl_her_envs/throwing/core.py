"""The throwing tasks on NumPy arrays: motion, catching, observations, goals and ends of episodes.

TorchRL's environments and gymnasium's both take their steps here. On arrays this small a call of NumPy costs
a tenth of a call of torch, and the state is one matrix, so that a step needs few calls.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from operator import itemgetter
from typing import NamedTuple

import numpy as np
import torch

from torchrl_her_envs.common.seeding import block_keys, uniform
from torchrl_her_envs.throwing.arm import Arm
from torchrl_her_envs.throwing.arrays import confined, within
from torchrl_her_envs.throwing.effector import Effector
from torchrl_her_envs.throwing.goals import BoxGoals, GoalDistribution, SectorGoals
from torchrl_her_envs.throwing.hand import Hand
from torchrl_her_envs.throwing.physics import BallPhysics
from torchrl_her_envs.throwing.rules import Arrays, Bodies, Numbers, take_step
from torchrl_her_envs.throwing.state import WorldState
from torchrl_her_envs.throwing.tasks import Task, WorldConfig

# Names of the moving entries, in the order of ``WorldState`` and ``Bodies``.
_BODIES = ("joints", "joint_velocity", "grip", "grip_velocity", "ball", "ball_velocity")
_FEW = 3  # number of worlds up to which plain numbers are faster than arrays
_HELD_FROM_THE_START = {"held": 1.0, "away": 0.0, "mixed": 0.5}


class Shown(NamedTuple):
    """Observed entries: ``state`` is the observation [N, ...] followed by the goal [N, 2].

    Each entry is a new array, which the caller may keep or change.
    """

    state: np.ndarray
    observation: np.ndarray
    achieved_goal: np.ndarray
    desired_goal: np.ndarray


class ThrowingCore:
    """N worlds in which a hand or an arm reaches for a ball or throws it into a black hole.

    Args:
        task: the task, see :data:`~torchrl_her_envs.TASKS`.
        num_envs: N, the number of worlds.

    Keyword Args:
        world: the constants of the physics.
        num_links: number of links of the arm, for the robot's tasks.
        threshold: distance below which a goal is achieved, in observed coordinates; the task's own if None.
        dtype: type of observations and goals; the physics is in float64.

    Attributes:
        task: the task, see :data:`~torchrl_her_envs.TASKS`.
        world: the constants of the physics.
        effector: the hand or the arm.
        threshold: distance below which a goal is achieved, in observed coordinates.
        fastest_ball: a bound on the speed of the ball, in meters a second.
        achieved_index: positions of the achieved goal in an observation.
        observation_size: number of entries of an observation.
        goal_distribution: distribution of desired goals, in the coordinates that the agent sees.
        worlds: the state that changes, as tensors that share memory with the arrays that steps write to.
        keys: [N] of uint64, see ``common.seeding``.

    Raises:
        ValueError: ``num_envs`` or ``num_links`` is below 1, ``threshold`` is not positive, or the task has a
            wall and ``world`` has too few substeps for it.

    Example:
        >>> from torchrl_her_envs import get_task
        >>> core = ThrowingCore(get_task("hand_v1"), 3)
        >>> core.set_seeds([0])
        >>> core.begin(np.arange(3))
        >>> core.show().observation.shape
        (3, 9)
        >>> core.advance(np.zeros((3, 3)))
        >>> core.out_of_time()
        array([False, False, False])
    """

    def __init__(
        self,
        task: Task,
        num_envs: int,
        *,
        world: WorldConfig | None = None,
        num_links: int = 2,
        threshold: float | None = None,
        dtype: type[np.floating] | np.dtype = np.float32,
    ) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs must be at least 1, got {num_envs}")
        if threshold is not None and not threshold > 0:
            raise ValueError(f"threshold must be positive, got {threshold}")
        self.task = task
        self.num_envs = num_envs
        self.world = world or WorldConfig()
        self.effector: Effector = (
            Hand(self.world, wall=task.wall)
            if task.effector == "hand"
            else Arm(self.world, num_links=num_links)
        )
        self.fastest_ball = self.world.fastest_ball(self._fastest_throw())
        if task.wall:
            self.world.check_wall(self.fastest_ball)
        self.observation_size = self.effector.observation_size + (4 if task.throws else 0)
        radius = self.world.hole_radius if task.throws else self.world.ball_radius
        self.threshold = self.world.shown(radius) if threshold is None else threshold
        self.dtype = np.dtype(dtype)
        self.ball_starts = self._make_ball_starts()
        self.goal_distribution = self._make_goals()
        self.keys = np.zeros(num_envs, np.uint64)
        self._catch = self.world.ball_radius * self.world.size
        physics = BallPhysics(num_envs, self.world, wall=task.wall)
        self._numbers = Numbers(self.effector, physics, self.world)
        self._arrays = Arrays(self.effector, physics, self.world)
        self._lay_out()

    # The state

    def _lay_out(self) -> None:
        """Allocates the state: a matrix whose first rows are observed, in meters, radians and seconds.

        A quantity is a row, or several, and a world is a column, so that a step is a few operations on long
        rows.
        """
        task, world, joints = self.task, self.world, self.effector.num_joints
        to_screen, to_speed = 2.0 / world.size, 1.0 / world.hand_speed
        quantities = {  # for each quantity: rows, and factor and shift to observed coordinates
            "cosines": (joints, 1.0, 0.0),
            "sines": (joints, 1.0, 0.0),
            "grip": (2, to_screen, -1.0),
            "joint_velocity": (joints, 1.0 / self.effector.action_speed, 0.0),
            "grip_velocity": (2, to_speed, 0.0),
            "closed": (1, 1.0, 0.0),
            "ball": (2, to_screen, -1.0),
            "ball_velocity": (2, to_speed, 0.0),
            "goal": (2, 1.0, 0.0),
            "joints": (joints, 1.0, 0.0),
        }
        observed = [*self.effector.shown, *(["ball", "ball_velocity"] if task.throws else []), "goal"]
        hidden = [name for name in _BODIES if name not in observed]
        if task.effector == "hand":  # a hand's joints are its grip: the same rows
            hidden = [name for name in hidden if not name.startswith("joint")]
        rows: dict[str, slice] = {}
        end = 0
        for name in [*observed, *hidden]:
            rows[name] = slice(end, end + quantities[name][0])
            end += quantities[name][0]
        self._matrix = np.zeros((end, self.num_envs))
        self._seen = self._matrix[: rows["goal"].stop]
        heights, *scaling = zip(*(quantities[name] for name in observed), strict=True)
        self._scale, self._shift = (np.repeat(values, heights)[:, None] for values in scaling)
        if task.effector == "hand":
            rows |= {"joints": rows["grip"], "joint_velocity": rows["grip_velocity"]}
        self._rows = rows
        self._body_rows = [rows[name] for name in _BODIES]
        self._bodies = [self._matrix[body_rows] for body_rows in self._body_rows]
        self._bodies_of = itemgetter(*self._body_rows)  # takes the bodies' rows from a column (a list)
        self._joints, self._joint_velocity, self._grip, self._grip_velocity, *balls = self._bodies
        self._ball, self._ball_velocity = balls
        self._angles = [self._matrix[rows[name]] for name in ("cosines", "sines") if name in rows]
        self._closed_shown, self._goal = self._matrix[rows["closed"]], self._matrix[rows["goal"]]
        self._flags = np.zeros((3, self.num_envs), np.bool_)
        self._closed, self._held, self._free = self._flags
        self._step, self._episode = np.zeros((2, self.num_envs), np.int64)
        self._action_shape = (self.num_envs, joints + 1)
        self.achieved_index = rows["ball" if task.throws else "grip"]
        self.worlds = WorldState(
            *(torch.from_numpy(array.T) for array in (*self._bodies, self._goal)),
            *(torch.from_numpy(array) for array in (*self._flags, self._step, self._episode)),
        )

    def set_seeds(self, seeds: Sequence[int]) -> None:
        """Seeds R equal blocks of worlds, each as if it were alone; episodes are counted from 0 again.

        Raises:
            ValueError: the worlds cannot be shared out among R blocks, or a seed is out of range.
        """
        self.keys = block_keys(seeds, self.num_envs)
        self._episode[:] = 0

    # The start of an episode

    def begin(self, which: np.ndarray) -> None:
        """Begins the next episode in the given worlds [M]."""
        self._episode[which] += 1
        self._step[which] = 0
        self.draw_starts(which)

    def draw_starts(self, which: np.ndarray) -> None:
        """Draws the starts of the present episodes of the given worlds [M]."""
        n = self.effector.num_joints
        u = uniform(self.keys[which], self._episode[which] - 1, n + 5)
        joints = self.effector.sample(u[:, :n])
        grip = self.effector.grip(joints)
        held = u[:, -1] < _HELD_FROM_THE_START[self.task.start]
        ball = np.where(held[:, None], grip, self.ball_starts.from_uniform(u[:, n : n + 2]))
        if self.task.throws:
            goal = self.goal_distribution.from_uniform(u[:, n + 2 : n + 4])
        else:
            goal = ball * (2.0 / self.world.size) - 1.0
        start = np.zeros((len(self._matrix), len(which)))  # all velocities start at 0
        for name, value in (("joints", joints), ("grip", grip), ("ball", ball), ("goal", goal)):
            start[self._rows[name]] = value.T
        self._matrix[:, which] = start
        self._closed[which] = self._held[which] = held
        self._free[which] = ~held & (self.task.effector == "hand")  # the robot's ball waits in the air

    # One step

    def advance(self, action: np.ndarray) -> None:
        """Takes a step, see :func:`~torchrl_her_envs.throwing.rules.take_step`.

        Args:
            action: [N, J + 1] of floating-point numbers: speeds of the joints, then the grip, which closes
                above 0. Numbers are clamped to [-1, 1].

        Raises:
            ValueError: actions of another shape, or that are not finite; nothing has moved then.
        """
        if action.shape != self._action_shape:
            raise ValueError(f"actions must be of shape {list(self._action_shape)}, got {list(action.shape)}")
        if self.num_envs <= _FEW:
            rows = action.tolist()
            for row in rows:
                if not all(map(math.isfinite, row)):
                    raise ValueError(_not_finite(action))
            for k, row in enumerate(rows):
                self._advance_one(k, *[confined(part, -1.0, 1.0) for part in row])
        else:
            command = np.array(action.T, np.float64)
            if not np.isfinite(command).all():
                raise ValueError(_not_finite(action))
            self._advance_all(confined(command, -1.0, 1.0))

    def _advance_one(self, k: int, *command: float) -> None:
        column, numbers = self._matrix[:, k].tolist(), self._numbers
        numbers.world = k
        *action, closing = command
        now = [*self._bodies_of(column), False, self._held.item(k), self._free.item(k)]
        after = take_step(Bodies(*now), action, closing > 0.0, numbers, catch=self._catch)
        for body_rows, value in zip(self._body_rows, after, strict=False):
            column[body_rows] = value
        self._matrix[:, k] = column
        *_, self._closed[k], self._held[k], self._free[k] = after
        self._step[k] += 1

    def _advance_all(self, command: np.ndarray) -> None:
        after = take_step(
            Bodies(*self._bodies, *self._flags),
            command[:-1],
            command[-1] > 0.0,
            self._arrays,
            catch=self._catch,
        )
        for body, value in zip(self._bodies, after[:6], strict=True):
            body[:] = value
        self._flags[:] = after[6:]
        self._step += 1

    # Observations and ends

    def show(self) -> Shown:
        """Returns the present observations of the agent."""
        state = self.show_state()
        return Shown(state, state[:, :-2].copy(), state[:, self.achieved_index].copy(), state[:, -2:].copy())

    def show_state(self) -> np.ndarray:
        """Returns the observations followed by the desired goals, as a new array [N, ...]."""
        self._closed_shown[:] = self._closed
        if self._angles:
            cosines, sines = self._angles
            np.cos(self._joints, out=cosines)
            np.sin(self._joints, out=sines)
        state = self._seen * self._scale
        state += self._shift
        return state.T.astype(self.dtype, order="C")

    def achieved(self, achieved_goal: np.ndarray, desired_goal: np.ndarray) -> np.ndarray:
        """Returns a mask [...] of pairs of observed goals [..., 2] that are nearer than the threshold."""
        dx, dy = (achieved_goal - desired_goal).T
        return within(dx, dy, self.threshold).T

    def out_of_time(self) -> np.ndarray:
        """Returns whether each episode has had its last step, as bool [N]."""
        return self._step >= self.world.max_steps

    # Constants of the task

    def _fastest_throw(self) -> float:
        """Returns a bound on the speed of the grip, in meters a second."""
        if self.task.effector == "hand":
            return math.sqrt(2.0) * self.world.hand_speed
        # Each joint moves the grip by turning all links between them.
        return self.world.joint_speed * self.world.arm_length * (self.effector.num_joints + 1) / 2

    def _make_ball_starts(self) -> GoalDistribution:
        """Makes the distribution of starts of balls that are not held, in meters."""
        config = self.world
        if self.task.effector == "hand":
            left, _, right, _ = (side * config.size for side in self.effector.reach)
            floor = config.ball_radius * config.size
            return BoxGoals((left, floor), (right, floor))
        base = (config.arm_base[0] * config.size, config.arm_base[1] * config.size)
        shortest, longest = (share * config.arm_length for share in config.arm_ball_radius)
        return SectorGoals(base, angle=config.arm_ball_angle, radius=(shortest, longest))

    def _make_goals(self) -> GoalDistribution:
        """Makes the distribution of goals, in observed coordinates."""
        config = self.world
        if self.task.throws:
            box = config.hand_goals if self.task.effector == "hand" else config.arm_goals
            left, bottom, right, top = (2.0 * side - 1.0 for side in box)
            return BoxGoals((left, bottom), (right, top))
        return self.ball_starts.scaled(2.0 / config.size, -1.0)


def _not_finite(action: np.ndarray) -> str:
    bad = int((~np.isfinite(action)).any(-1).nonzero()[0][0])
    return f"actions must be finite, got {action[bad].tolist()} in environment {bad}"
