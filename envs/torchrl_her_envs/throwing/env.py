"""The environment behind all eleven throwing and reaching tasks."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torchrl.data import Bounded, Unbounded
from torchrl.envs import EnvBase

from torchrl_her_envs.common.batched_env import BatchedEnv
from torchrl_her_envs.common.goal_env import Box, first_below
from torchrl_her_envs.common.seeding import as_seeds, uniform
from torchrl_her_envs.throwing.arm import Arm
from torchrl_her_envs.throwing.effector import Effector
from torchrl_her_envs.throwing.goals import BoxGoals, GoalDistribution, SectorGoals
from torchrl_her_envs.throwing.hand import Hand
from torchrl_her_envs.throwing.physics import BallPhysics
from torchrl_her_envs.throwing.rendering.canvas import MARGIN
from torchrl_her_envs.throwing.rendering.render import render
from torchrl_her_envs.throwing.state import WorldState
from torchrl_her_envs.throwing.tasks import Task, WorldConfig

_PICTURE = 300  # pixels of a side, unless told otherwise


class ThrowingEnv(BatchedEnv):
    """N environments in which a hand or an arm reaches for a ball or throws it into a black hole.

    Keys: ``observation``, ``achieved_goal``, ``desired_goal`` (gymnasium's GoalEnv convention),
    ``state`` (the observation with the desired goal behind it), ``action`` in [-1, 1] (speeds of
    the joints, then the grip: above 0 it closes), ``reward`` (0 where the goal is achieved, -1
    elsewhere), ``terminated`` (the goal is achieved), ``truncated`` (the last step), ``done``.

    Positions are shown as ``2 * screen - 1``. The environments are independent: environment k with a
    given seed does the same in every batch, and a partial reset leaves the others as they are.

    Args:
        task: what is to be done; see :data:`~torchrl_her_envs.TASKS`.
        num_envs: N, the number of environments.
        seed: of all random starts and goals; R seeds for R equal blocks of environments, each as if alone.
        world: the constants of the physics.
        num_links: number of links of the arm, for the robot's tasks.
        threshold: how near to the goal is achieved, in shown coordinates; the task's own if None.
        dtype: type of observations, goals, actions and rewards, or its name; the physics is in float64.

    Attributes:
        task: what is to be done.
        world: the constants of the physics.
        effector: the hand or the arm.
        threshold: how near to the goal is achieved, in shown coordinates.
        worlds: the state of all environments.

    Raises:
        ValueError: ``num_envs`` or ``num_links`` is below 1, ``threshold`` is not positive, or ``dtype`` is
            not a floating-point type.

    Example:
        >>> from torchrl_her_envs import make_env
        >>> env = make_env("hand_v1", num_envs=3, seed=0)
        >>> env.rollout(10, break_when_any_done=False)["next", "reward"].shape
        torch.Size([3, 10, 1])
    """

    def __init__(
        self,
        task: Task,
        *,
        num_envs: int = 1,
        seed: int | Sequence[int] = 0,
        world: WorldConfig | None = None,
        num_links: int = 2,
        threshold: float | None = None,
        dtype: torch.dtype | str = "float32",
    ) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs must be at least 1, got {num_envs}")
        if threshold is not None and not threshold > 0:
            raise ValueError(f"threshold must be positive, got {threshold}")
        super().__init__(num_envs)
        self.task = task
        self.world = world or WorldConfig()
        self.max_steps = self.world.max_steps
        self.dtype_shown = _as_dtype(dtype)
        self.effector: Effector = (
            Hand(self.world, wall=task.wall)
            if task.effector == "hand"
            else Arm(self.world, num_links=num_links)
        )
        own = self.world.hole_radius if task.throws else self.world.ball_radius
        self.threshold = self.world.shown(own) if threshold is None else threshold
        self._catch = self.world.ball_radius * self.world.size
        self._ball_starts = self._make_ball_starts()
        self._goals: GoalDistribution = self._make_goals()
        self.worlds = WorldState.zeros(num_envs, self.effector.num_joints)
        shape = (num_envs, self.effector.num_joints + 1)
        self._make_specs(
            self.effector.observation_size + (4 if task.throws else 0),
            2,
            seen=partial(Unbounded, dtype=self.dtype_shown),
            action=Bounded(low=-1.0, high=1.0, shape=shape, dtype=self.dtype_shown),
        )
        self._physics: list[BallPhysics] = []
        self.set_seeds(as_seeds(seed))

    # What the task is

    @property
    def task_name(self) -> str:
        return self.task.name

    @property
    def goal_distribution(self) -> GoalDistribution:
        """The distribution of desired goals, in the coordinates that the agent sees."""
        return self._goals

    @property
    def goal_sigma(self) -> float:
        return self.task.goal_sigma

    @property
    def starts_near_goals(self) -> bool:
        """True where the goal is the ball: it lies where hands and arms start."""
        return not self.task.throws

    @property
    def can_render(self) -> bool:
        return True

    def compute_terminated(self, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
        """Whether goals [..., 2] are nearer to each other than the threshold: [..., 1] of bool."""
        return _near(achieved_goal, desired_goal, self.threshold).unsqueeze(-1)

    def layers(self) -> list[dict[str, Any]]:
        """Two layers: reach the ball; then throw it into the black hole.

        In the first layer the agent sees the hand or the arm, and wants its grip at the ball. In the second
        it also sees the ball, at the place in its input where the first layer had its goal, and wants the
        ball in the black hole. Goals of the first layer lie where episodes start, so IBS weights do not
        apply to them.

        Raises:
            ValueError: the task has no throw, so reaching is all of it.
        """
        if not self.task.throws:
            raise ValueError(f"{self.task_name} has no curriculum: it has one layer; choose a throwing task")
        seen = self.effector.observation_size
        ball = [seen, seen + 1]
        return [
            {
                "name": "reach",
                "observation": list(range(seen)),
                "achieved_goal": list(self.effector.grip_index),
                "desired_goal": ball,
                "threshold": self.world.shown(self.world.ball_radius),
                "instructive": False,
            },
            {
                "name": "throw",
                "observation": list(range(seen + 4)),
                "achieved_goal": ball,
                "desired_goal": [seen + 4, seen + 5],
                "threshold": self.threshold,
                "instructive": True,
            },
        ]

    def state_names(self) -> dict[str, list[int]]:
        """Names for entries of the state.

        They are ``hand`` or ``arm`` (all that is seen of it), ``grip`` (where its end is), ``ball`` and, if
        it is thrown, ``ball_speed`` and ``hole``; besides ``observation`` and ``desired_goal``.
        """
        seen = self.effector.observation_size
        own = {self.task.effector: list(range(seen)), "grip": list(self.effector.grip_index)}
        pairs = ("ball", "ball_speed", "hole") if self.task.throws else ("ball",)
        for place, name in enumerate(pairs):
            own[name] = [seen + 2 * place, seen + 2 * place + 1]
        return own | super().state_names()

    def goal_box(self) -> Box:
        """The screen; a stretched arm's end goes less than 0.01 beyond its left side."""
        return [-1.0, -1.0], [1.0, 1.0]

    def picture_box(self) -> Box:
        """The screen with the margin that pictures have around it."""
        edge = 1.0 + 2.0 * MARGIN  # the screen is two wide
        return [-edge, -edge], [edge, edge]

    def regions(self) -> dict[str, Box]:
        """The boxes around where goals lie (``"goals"``) and what the hand or arm reaches (``"reach"``)."""
        left, bottom, right, top = (2.0 * side - 1.0 for side in self.effector.reach)
        return {
            "goals": (self._goals.low.tolist(), self._goals.high.tolist()),
            "reach": ([left, bottom], [right, top]),
        }

    def trail_points(self) -> Tensor:
        """The balls [N, 2] in meters."""
        return self.worlds.ball.clone()

    def render(
        self,
        worlds: int | Sequence[int] | None = 0,
        *,
        size: int | None = None,
        trail: Sequence[Tensor] = (),
        caption: str = "",
    ) -> Tensor:
        """Draws environments as they are now, as :func:`~torchrl_her_envs.render` does.

        Args:
            worlds: an index, several, or None for all environments of the batch.
            size: side of each picture in pixels; 300 if None.
            trail: earlier values of :meth:`trail_points`, oldest first, drawn as fading dots.
            caption: a line of text in each picture.

        Returns:
            Pictures [len(worlds), size, size, 3] of uint8; without the first dimension for one index.

        Raises:
            ValueError: an index that is out of range, or a size that is too small.
        """
        return render(self, worlds, size=_PICTURE if size is None else size, trail=trail, caption=caption)

    def set_seeds(self, seeds: Sequence[int]) -> None:
        super().set_seeds(seeds)
        if len(self._physics) != len(seeds):
            # A space for each block: the last bits of a ball's path depend on where its world lies in it.
            size = self.batch_size[0] // len(seeds)
            self._physics = [BallPhysics(size, self.world, wall=self.task.wall) for _ in seeds]

    # One step, and the start of an episode

    def _check_action(self, action: Tensor) -> None:
        if action.shape != self.action_spec.shape:
            expected = list(self.action_spec.shape)
            raise ValueError(f"actions must be of shape {expected}, got {list(action.shape)}")
        if not bool(action.isfinite().all()):
            bad = (~action.isfinite()).any(-1).nonzero().flatten().tolist()
            raise ValueError(f"actions must be finite, got {action[bad[0]].tolist()} in environment {bad[0]}")

    def _advance(self, action: Tensor) -> None:
        """Opens or closes the grip, moves, lets the free balls fly, and catches."""
        action = action.to(torch.float64).clamp(-1.0, 1.0)
        w, dt = self.worlds, self.world.time_step
        closed = action[:, -1] > 0
        released = w.held & ~closed
        # A released ball keeps the velocity that the hand had in the step before.
        ball_velocity = torch.where(released.unsqueeze(-1), w.grip_velocity, w.ball_velocity)
        held, free = w.held & closed, w.free | released

        joints = self.effector.move(w.joints, action[:, :-1] * (self.effector.action_speed * dt))
        grip = self.effector.grip(joints)
        grip_velocity = (grip - w.grip) / dt
        flown, flown_velocity = self._fly(w.ball, ball_velocity, free)

        held = held | (closed & _near(flown, grip, self._catch))
        held_ = held.unsqueeze(-1)
        w.joint_velocity = (joints - w.joints) / dt
        w.joints, w.grip, w.grip_velocity = joints, grip, grip_velocity
        w.ball = torch.where(held_, grip, flown)
        w.ball_velocity = torch.where(held_, grip_velocity, flown_velocity)
        w.closed, w.held, w.free = closed, held, free & ~held

    def _fly(self, ball: Tensor, velocity: Tensor, free: Tensor) -> tuple[Tensor, Tensor]:
        """One time step of the balls that are free; the others stay as they are."""
        if len(self._physics) == 1:
            return self._physics[0].step(ball, velocity, free)
        blocks = zip(*(entry.chunk(len(self._physics)) for entry in (ball, velocity, free)), strict=True)
        flown = [physics.step(*block) for physics, block in zip(self._physics, blocks, strict=True)]
        balls, velocities = zip(*flown, strict=True)
        return torch.cat(balls), torch.cat(velocities)

    def _start_episodes(self, which: Tensor) -> None:
        w, n = self.worlds, self.effector.num_joints
        u = uniform(self._keys[which.numpy()], w.episode[which] - 1, n + 5)
        joints = self.effector.sample(u[:, :n])
        grip = self.effector.grip(joints)
        start = self.task.start
        held = u[:, -1] < {"held": 1.0, "away": 0.0, "mixed": 0.5}[start]
        away = self._ball_starts.from_uniform(u[:, n : n + 2])
        ball = torch.where(held.unsqueeze(-1), grip, away)
        goal = self._goals.from_uniform(u[:, n + 2 : n + 4]) if self.task.throws else self._scale(ball)
        for name, value in {
            "joints": joints,
            "joint_velocity": 0.0,
            "grip": grip,
            "grip_velocity": 0.0,
            "ball": ball,
            "ball_velocity": 0.0,
            "goal": goal,
            "closed": held,
            "held": held,
            "free": ~held & (self.task.effector == "hand"),  # the robot's ball waits in the air
        }.items():
            getattr(w, name)[which] = value

    def _scale(self, meters: Tensor) -> Tensor:
        return meters * (2.0 / self.world.size) - 1.0

    def _show(self) -> dict[str, Tensor]:
        w, config = self.worlds, self.world
        grip, ball = self._scale(w.grip), self._scale(w.ball)
        parts = [
            self.effector.observe(
                w.joints,
                w.joint_velocity / self.effector.action_speed,
                grip,
                w.grip_velocity / config.hand_speed,
                w.closed.unsqueeze(-1).to(torch.float64),
            )
        ]
        if self.task.throws:
            parts += [ball, w.ball_velocity / config.hand_speed]
        state = torch.cat([*parts, w.goal], -1).to(self.dtype_shown)
        achieved = (ball if self.task.throws else grip).to(self.dtype_shown)
        return {
            "state": state,
            "observation": state[:, :-2].clone(),
            "achieved_goal": achieved,
            "desired_goal": state[:, -2:].clone(),
        }

    # Made once

    def _make_ball_starts(self) -> GoalDistribution:
        """Where a ball that is not held starts, in meters."""
        config = self.world
        if self.task.effector == "hand":
            left, _, right, _ = (side * config.size for side in self.effector.reach)
            floor = config.ball_radius * config.size
            return BoxGoals((left, floor), (right, floor))
        base = (config.arm_base[0] * config.size, config.arm_base[1] * config.size)
        shortest, longest = (share * config.arm_length for share in config.arm_ball_radius)
        return SectorGoals(base, angle=config.arm_ball_angle, radius=(shortest, longest))

    def _make_goals(self) -> GoalDistribution:
        """Where goals start, as the agent sees them."""
        config = self.world
        if self.task.throws:
            box = config.hand_goals if self.task.effector == "hand" else config.arm_goals
            left, bottom, right, top = (2.0 * side - 1.0 for side in box)
            return BoxGoals((left, bottom), (right, top))
        return self._ball_starts.scaled(2.0 / config.size, -1.0)


def base_env(env: EnvBase) -> ThrowingEnv:
    """The throwing environment below any transforms.

    Raises:
        TypeError: there is none.

    Example:
        >>> from torchrl.envs import StepCounter, TransformedEnv
        >>> from torchrl_her_envs import make_env
        >>> base_env(TransformedEnv(make_env("hand_v1"), StepCounter())).task.name
        'hand_v1'
    """
    inner = first_below(env, lambda inner: isinstance(inner, ThrowingEnv))
    if not isinstance(inner, ThrowingEnv):
        raise TypeError(f"expected a ThrowingEnv, transformed or not, got {type(env).__name__}")
    return inner


def _as_dtype(dtype: torch.dtype | str) -> torch.dtype:
    """A floating-point type, which may be given by name."""
    named = getattr(torch, dtype, None) if isinstance(dtype, str) else dtype
    if not isinstance(named, torch.dtype) or not named.is_floating_point:
        raise ValueError(f"dtype must be a floating-point type such as float32 or float64, got {dtype!r}")
    return named


def _near(point: Tensor, other: Tensor, distance: float) -> Tensor:
    """Whether points [..., 2] are nearer to each other than a distance: [...] of bool."""
    # One coordinate after the other: torch takes several times as long to sum over two numbers.
    (x, y), (other_x, other_y) = point.unbind(-1), other.unbind(-1)
    return (x - other_x).square() + (y - other_y).square() < distance**2
