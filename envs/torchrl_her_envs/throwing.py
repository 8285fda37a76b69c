"""The environment behind all eleven tasks: batched, TensorDict-native, with goals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded

from torchrl_her_envs.effector import Effector
from torchrl_her_envs.goals import BoxGoals, GoalDistribution, SectorGoals
from torchrl_her_envs.hand import Hand
from torchrl_her_envs.physics import BallPhysics
from torchrl_her_envs.rendering import render
from torchrl_her_envs.robot import Arm
from torchrl_her_envs.seeded_worlds import SeededWorlds
from torchrl_her_envs.seeding import as_seeds, uniform
from torchrl_her_envs.task import Task, WorldConfig


@dataclass
class WorldState:
    """All that N worlds are, in metres, radians and seconds. Every tensor has N rows.

    ``free`` says that the ball obeys physics (it does not while it is held, nor does the robot's
    before it was first held); ``episode`` counts the resets of a world.
    """

    joints: Tensor
    joint_velocity: Tensor
    grip: Tensor
    grip_velocity: Tensor
    ball: Tensor
    ball_velocity: Tensor
    goal: Tensor
    closed: Tensor
    held: Tensor
    free: Tensor
    step: Tensor
    episode: Tensor

    @classmethod
    def zeros(cls, num_worlds: int, num_joints: int) -> WorldState:
        """N worlds before their first reset."""

        def points(n: int) -> Tensor:
            return torch.zeros(num_worlds, n, dtype=torch.float64)

        def flags(dtype: torch.dtype) -> Tensor:
            return torch.zeros(num_worlds, dtype=dtype)

        return cls(
            points(num_joints),
            points(num_joints),
            *(points(2) for _ in range(5)),
            *(flags(torch.bool) for _ in range(3)),
            *(flags(torch.int64) for _ in range(2)),
        )


class ThrowingEnv(SeededWorlds):
    """N worlds in which a hand or an arm reaches for a ball or throws it into a black hole.

    Keys: ``observation``, ``achieved_goal``, ``desired_goal`` (gymnasium's GoalEnv convention),
    ``state`` (the observation with the desired goal behind it), ``action`` in [-1, 1] (speeds of
    the joints, then the grip: above 0 it closes), ``reward`` (0 where the goal is achieved, -1
    elsewhere), ``terminated`` (the goal is achieved), ``truncated`` (the last step), ``done``.

    Positions are shown as ``2 * screen - 1``. Worlds are independent: world k with a given seed
    does the same in every batch, and a partial reset leaves the others as they are.

    Args:
        task: what is to be done; see :data:`~torchrl_her_envs.TASKS`.
        num_envs: N, the number of worlds.
        seed: of all random starts and goals; R seeds for R equal blocks of worlds, each as if alone.
        world: the constants.
        num_links: of the arm.
        threshold: how near to the goal is achieved, in shown coordinates; the task's if None.
        dtype: of observations, goals, actions and rewards; the worlds themselves are in float64.

    Raises:
        ValueError: ``num_envs`` or ``num_links`` is below 1, or ``threshold`` is not positive.

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
        dtype: torch.dtype = torch.float32,
    ) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs must be at least 1, got {num_envs}")
        if threshold is not None and not threshold > 0:
            raise ValueError(f"threshold must be positive, got {threshold}")
        super().__init__(device="cpu", batch_size=(num_envs,))
        self.task = task
        self.world = world or WorldConfig()
        self.dtype_shown = dtype
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
        self._make_specs()
        self._physics: list[BallPhysics] = []
        self.set_seeds(as_seeds(seed))

    # What the outside asks for

    @property
    def goal_distribution(self) -> GoalDistribution:
        """Where desired goals come from, in the coordinates that the agent sees."""
        return self._goals

    @property
    def max_steps(self) -> int:
        """Steps after which an episode is truncated."""
        return self.world.max_steps

    def compute_reward(self, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
        """The reward of having achieved one goal when another was desired.

        Args:
            achieved_goal: [..., 2].
            desired_goal: [..., 2], broadcast against it.

        Returns:
            [..., 1]: 0 where they are nearer than the task's threshold, -1 elsewhere.
        """
        return self.compute_terminated(achieved_goal, desired_goal).to(achieved_goal.dtype) - 1.0

    def compute_terminated(self, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
        """Whether the goal is achieved, which ends an episode: [..., 1] of bool."""
        return _near(achieved_goal, desired_goal, self.threshold).unsqueeze(-1)

    def render(self, worlds: int | Sequence[int] | None = 0, *, size: int = 300) -> Tensor:
        """Draws worlds as they are now; see :func:`~torchrl_her_envs.render` for more options.

        Args:
            worlds: an index, several, or None for all.
            size: side of each picture in pixels.

        Returns:
            [size, size, 3] of uint8, with a dimension for the worlds in front unless one index was given.

        Raises:
            ValueError: a world that does not exist, or a size that is too small.
        """
        return render(self, worlds, size=size)

    def set_seeds(self, seeds: Sequence[int]) -> None:
        super().set_seeds(seeds)
        if len(self._physics) != len(seeds):
            # A space for each block: the last bits of a ball's path depend on where its world lies in it.
            size = self.batch_size[0] // len(seeds)
            self._physics = [BallPhysics(size, self.world, wall=self.task.wall) for _ in seeds]

    # TorchRL's hooks

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: object) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is None or bool(mask.all()):
            which = torch.arange(self.batch_size[0])
        else:
            which = mask.view(-1).nonzero().squeeze(-1)
        self._start_episodes(which)
        shown = self._show()
        off = torch.zeros(*self.batch_size, 1, dtype=torch.bool)
        shown.update({"done": off, "terminated": off.clone(), "truncated": off.clone()})
        # With the device that it has anyway: otherwise TorchRL copies every entry.
        return TensorDict(shown, batch_size=self.batch_size, device=self.device)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict.get("action")
        if action.shape != self.action_spec.shape:
            expected = list(self.action_spec.shape)
            raise ValueError(f"actions must be of shape {expected}, got {list(action.shape)}")
        if not bool(action.isfinite().all()):
            bad = (~action.isfinite()).any(-1).nonzero().flatten().tolist()
            raise ValueError(f"actions must be finite, got {action[bad[0]].tolist()} in world {bad[0]}")
        self._advance(action.to(torch.float64).clamp(-1.0, 1.0))
        shown = self._show()
        terminated = self.compute_terminated(shown["achieved_goal"], shown["desired_goal"])
        truncated = (self.worlds.step >= self.world.max_steps).unsqueeze(-1)
        shown["reward"] = terminated.to(self.dtype_shown) - 1.0
        shown.update({"terminated": terminated, "truncated": truncated, "done": terminated | truncated})
        return TensorDict(shown, batch_size=self.batch_size, device=self.device)

    # The worlds

    def _advance(self, action: Tensor) -> None:
        """One time step: open or close, move, let the balls fly, catch."""
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
        w.step = w.step + 1

    def _fly(self, ball: Tensor, velocity: Tensor, free: Tensor) -> tuple[Tensor, Tensor]:
        """One time step of the balls that are free; the others stay as they are."""
        if len(self._physics) == 1:
            return self._physics[0].step(ball, velocity, free)
        blocks = zip(*(entry.chunk(len(self._physics)) for entry in (ball, velocity, free)), strict=True)
        flown = [physics.step(*block) for physics, block in zip(self._physics, blocks, strict=True)]
        balls, velocities = zip(*flown, strict=True)
        return torch.cat(balls), torch.cat(velocities)

    def _start_episodes(self, which: Tensor) -> None:
        """Draws the starts of new episodes in the given worlds [M]."""
        w, n = self.worlds, self.effector.num_joints
        u = uniform(self._keys[which.numpy()], w.episode[which], n + 5)
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
            "step": 0,
        }.items():
            getattr(w, name)[which] = value
        w.episode[which] += 1

    def _scale(self, metres: Tensor) -> Tensor:
        return metres * (2.0 / self.world.size) - 1.0

    def _show(self) -> dict[str, Tensor]:
        """What the agent sees of the worlds."""
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
        """Where a ball that is not held starts, in metres."""
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

    def _make_specs(self) -> None:
        (n,) = self.batch_size
        size = self.effector.observation_size + (4 if self.task.throws else 0)

        def seen(width: int) -> Unbounded:
            return Unbounded(shape=(n, width), dtype=self.dtype_shown)

        def flag() -> Binary:
            return Binary(n=1, shape=(n, 1), dtype=torch.bool)

        self.observation_spec = Composite(
            state=seen(size + 2),
            observation=seen(size),
            achieved_goal=seen(2),
            desired_goal=seen(2),
            shape=(n,),
        )
        width = self.effector.num_joints + 1
        self.action_spec = Bounded(low=-1.0, high=1.0, shape=(n, width), dtype=self.dtype_shown)
        self.reward_spec = Unbounded(shape=(n, 1), dtype=self.dtype_shown)
        self.done_spec = Composite(done=flag(), terminated=flag(), truncated=flag(), shape=(n,))


def _near(point: Tensor, other: Tensor, distance: float) -> Tensor:
    """Whether points [..., 2] are nearer to each other than a distance: [...] of bool."""
    # One coordinate after the other: torch takes several times as long to sum over two numbers.
    (x, y), (other_x, other_y) = point.unbind(-1), other.unbind(-1)
    return (x - other_x).square() + (y - other_y).square() < distance**2
