"""Scripted controllers that compute with the physics, and show that every task can be solved."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_her_envs.throwing.effector import Effector
from torchrl_her_envs.throwing.env import base_env
from torchrl_her_envs.throwing.experts.arm import ArmSkill
from torchrl_her_envs.throwing.experts.clearance import will_hit
from torchrl_her_envs.throwing.experts.hand import HandSkill
from torchrl_her_envs.throwing.tasks import Task, WorldConfig

_CHUNK = 16  # number of plans made at once, whose thousands of throws should fit into the cache
_PLANNED = 0.8  # share of the threshold by which a planned throw may miss the goal
_LET_GO = 0.9  # share of the threshold by which a throw may miss on release; the margin is for rounding


class Skill(Protocol):
    """Skill of a hand or an arm that a controller combines, in meters, radians and seconds."""

    effector: Effector

    def joints(self, state: Tensor) -> Tensor:
        """Returns the joints [B, J] in a state [B, S]."""
        ...

    def reach(self, joints: Tensor, target: Tensor) -> Tensor:
        """Returns the velocity [B, J] of the joints to bring the grip to a point [B, 2] in one step."""
        ...

    def throw(self, joints: Tensor, goal: Tensor, *, within: float) -> Tensor:
        """Returns the next velocity [B, J] of the joints to carry or swing a ball towards its goal [B, 2]."""
        ...


@dataclass
class _Seen:
    """Inputs of a controller from B states: joints [B, J], points and velocities [B, 2], flags [B]."""

    joints: Tensor
    ball: Tensor
    ball_velocity: Tensor
    goal: Tensor
    held: Tensor


class Controller(TensorDictModuleBase):
    """A policy that reaches for the ball, closes, carries, and lets go when the ball will fly into the goal.

    It reads nothing but the ``state`` that the agent observes (observation and goal), and has no memory from
    one step to the next. So it needs no reset between episodes, and takes recorded states of any batch shape.

    Args:
        task: the task, see :data:`~torchrl_her_envs.TASKS`.
        world: the constants of the world.
        threshold: distance below which a goal is achieved, in observed coordinates; the task's if None. With
            a far smaller threshold the arm may find no throw, since it tries a grid of throws.
        num_links: number of links of the arm, for the robot's tasks.

    Raises:
        ValueError: the arm does not have two links.

    Example:
        >>> from torchrl_her_envs import make_controller, make_env
        >>> env = make_env("hand_v1", num_envs=3, seed=0)
        >>> episodes = env.rollout(50, make_controller(env), break_when_any_done=False)
        >>> episodes["next", "terminated"].any(1).all()
        tensor(True)
    """

    in_keys = ["state"]  # noqa: RUF012 (the base class declares them without ClassVar)
    out_keys = ["action"]  # noqa: RUF012

    def __init__(
        self, task: Task, world: WorldConfig, *, threshold: float | None = None, num_links: int = 2
    ) -> None:
        super().__init__()
        self.task, self.world = task, world
        distance = world.shown(world.hole_radius) if threshold is None else threshold
        self._threshold = distance * world.size / 2.0  # in meters
        self.skill: Skill = (
            HandSkill(world, wall=task.wall)
            if task.effector == "hand"
            else ArmSkill(world, num_links=num_links)
        )

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes ``action`` [..., J + 1] for ``state`` [..., S]."""
        state = tensordict.get("state")
        action = self.act(state.reshape(-1, state.shape[-1]).to(torch.float32))
        return tensordict.set("action", action.view(*state.shape[:-1], -1).to(state.dtype))

    def act(self, state: Tensor) -> Tensor:
        """Returns the actions [B, J + 1] for states [B, S] of float32."""
        seen, speed = self._read(state), self.skill.effector.action_speed
        flying, within = self._flies_home(seen), _PLANNED * self._threshold
        target = seen.ball + seen.ball_velocity * self.world.time_step
        velocity = self.skill.reach(seen.joints, target)
        for some in (seen.held & ~flying).nonzero().squeeze(-1).split(_CHUNK):
            velocity[some] = self.skill.throw(seen.joints[some], seen.goal[some], within=within)
        velocity[flying] = 0.0
        turn = (velocity / speed).clamp(-1.0, 1.0)
        after = self.skill.effector.move(seen.joints, turn * (speed * self.world.time_step))
        closed = (seen.held | self._can_catch(after, target)) & ~flying
        return torch.cat((turn, torch.where(closed, 1.0, -1.0).unsqueeze(-1)), -1)

    def _read(self, state: Tensor) -> _Seen:
        joints, goal = self.skill.joints(state), self._meters(state[:, -2:])
        if not self.task.throws:  # in reaching tasks the goal is the ball, at rest
            return _Seen(joints, goal, torch.zeros_like(goal), goal, torch.zeros(len(goal), dtype=torch.bool))
        ball, velocity = self._meters(state[:, -6:-4]), state[:, -4:-2] * self.world.hand_speed
        closed = state[:, -7] > 0.5
        # A closed hand that is near enough to catch the ball holds it already, by the dynamics.
        return _Seen(joints, ball, velocity, goal, closed & self._can_catch(joints, ball))

    def _flies_home(self, seen: _Seen) -> Tensor:
        """Returns whether a ball that is released now flies into the goal."""
        if not self.task.throws:
            return torch.zeros_like(seen.held)
        wall, within = self.task.wall, _LET_GO * self._threshold
        return will_hit(seen.ball, seen.ball_velocity, seen.goal, self.world, wall=wall, within=within)

    def _can_catch(self, joints: Tensor, ball: Tensor) -> Tensor:
        gap = self.skill.effector.grip(joints) - ball
        return gap.square().sum(-1) < (self.world.ball_radius * self.world.size) ** 2

    def _meters(self, places: Tensor) -> Tensor:
        return (places + 1.0) * (self.world.size / 2.0)


def make_controller(env: EnvBase) -> Controller:
    """Makes the scripted controller for an environment's task.

    Args:
        env: a :class:`~torchrl_her_envs.ThrowingEnv`, transformed or not. Only its task and its constants
            are used, once. Transforms must leave ``state`` as it is.

    Raises:
        TypeError: there is no throwing environment below the transforms.
        ValueError: the arm does not have two links.

    Example:
        >>> from torchrl_her_envs import make_env
        >>> make_controller(make_env("robot_v0")).task.name
        'robot_v0'
    """
    inner = base_env(env)
    num_links = inner.effector.num_joints
    return Controller(inner.task, inner.world, threshold=inner.threshold, num_links=num_links)
