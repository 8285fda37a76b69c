"""The environment of all eleven throwing and reaching tasks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torchrl.data import Bounded, Unbounded
from torchrl.envs import EnvBase

from torchrl_her_envs.common.batched_env import BatchedEnv
from torchrl_her_envs.common.goal_env import Box, first_below
from torchrl_her_envs.common.seeding import as_seeds
from torchrl_her_envs.throwing.arrays import within
from torchrl_her_envs.throwing.core import ThrowingCore
from torchrl_her_envs.throwing.goals import GoalDistribution
from torchrl_her_envs.throwing.rendering.canvas import MARGIN
from torchrl_her_envs.throwing.rendering.render import render
from torchrl_her_envs.throwing.rules import reward_of
from torchrl_her_envs.throwing.state import WorldState
from torchrl_her_envs.throwing.tasks import Task, WorldConfig

_PICTURE = 300  # default side of a picture in pixels
_OF_NUMPY: dict[torch.dtype, type[np.floating]] = {  # NumPy's types for those of torch
    torch.float16: np.float16,
    torch.float32: np.float32,
    torch.float64: np.float64,
}


class ThrowingEnv(BatchedEnv):
    """N environments in which a hand or an arm reaches for a ball or throws it into a black hole.

    Keys: ``observation``, ``achieved_goal``, ``desired_goal`` (gymnasium's GoalEnv convention),
    ``state`` (the observation followed by the desired goal), ``action`` in [-1, 1] (speeds of
    the joints, then the grip: above 0 it closes), ``reward`` (0 where the goal is achieved, -1
    elsewhere), ``terminated`` (the goal is achieved), ``truncated`` (the last step), ``done``.

    Positions are observed as ``2 * screen - 1``. The environments are independent: environment k with a given
    seed does the same in every batch, and a partial reset leaves the others as they are.

    pymunk computes contacts and bounces only. Array code computes free flight, with the same results as
    Chipmunk (pymunk's engine), and hand, arm, catching, goals and rewards.

    Args:
        task: the task, one of :data:`~torchrl_her_envs.TASKS`.
        num_envs: N, the number of environments.
        seed: seed of all random starts and goals; R seeds for R equal blocks of environments, each as if
            alone.
        world: the constants of the physics.
        num_links: number of links of the arm, for the robot's tasks.
        threshold: distance below which a goal is achieved, in observed coordinates; the task's own if None.
        dtype: type of observations, goals, actions and rewards, or its name; the physics is in float64.

    Attributes:
        task: the task, see :data:`~torchrl_her_envs.TASKS`.
        world: the constants of the physics.
        effector: the hand or the arm.
        threshold: distance below which a goal is achieved, in observed coordinates.
        worlds: the state of all environments, which every step writes to: clone what you want to keep.

    Raises:
        ValueError: ``num_envs`` or ``num_links`` is below 1, ``threshold`` is not positive, ``dtype`` is not
            a floating-point type, or the task has a wall and ``world`` has too few substeps for it.
        TypeError: a seed is not an integer.

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
        shown_dtype = _as_dtype(dtype)
        core = ThrowingCore(
            task,
            num_envs,
            world=world,
            num_links=num_links,
            threshold=threshold,
            dtype=_OF_NUMPY.get(shown_dtype, np.float64),
        )
        super().__init__(num_envs)
        self.dtype_shown, self._native = shown_dtype, shown_dtype in _OF_NUMPY
        self._core = core
        self.task, self.world, self.effector, self.threshold = task, core.world, core.effector, core.threshold
        self.max_steps = self.world.max_steps
        self.worlds: WorldState = core.worlds
        shape = (num_envs, self.effector.num_joints + 1)
        self._make_specs(
            core.observation_size,
            2,
            seen=partial(Unbounded, dtype=self.dtype_shown),
            action=Bounded(low=-1.0, high=1.0, shape=shape, dtype=self.dtype_shown),
        )
        self.set_seeds(as_seeds(seed))

    # Properties of the task

    @property
    def task_name(self) -> str:
        return self.task.name

    @property
    def goal_distribution(self) -> GoalDistribution:
        """Distribution of desired goals, in the coordinates that the agent sees."""
        return self._core.goal_distribution

    @property
    def goal_sigma(self) -> float:
        return self.task.goal_sigma

    @property
    def starts_near_goals(self) -> bool:
        """Whether goals lie where hands and arms start: True if the goal is the ball."""
        return not self.task.throws

    @property
    def can_render(self) -> bool:
        return True

    def compute_terminated(self, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
        """Returns whether pairs of goals [..., 2] are nearer than the threshold, as bool [..., 1]."""
        (x, y), (other_x, other_y) = achieved_goal.unbind(-1), desired_goal.unbind(-1)
        return within(x - other_x, y - other_y, self.threshold).unsqueeze(-1)

    def stages(self) -> list[dict[str, Any]]:
        """Returns two stages: reach the ball; then throw it into the black hole.

        In the first stage the agent observes the hand or the arm, and the goal of its grip is the ball. In
        the second it also observes the ball, at the inputs where the first stage had its goal, and the ball's
        goal is the black hole. Goals of the first stage lie where episodes start, so IBS weights do not apply
        to them.

        Raises:
            ValueError: the task is a reaching task, which has no stages.
        """
        if not self.task.throws:
            raise ValueError(f"{self.task_name} has no curriculum: it has one stage; choose a throwing task")
        observed = self.effector.observation_size
        ball = [observed, observed + 1]
        return [
            {
                "name": "reach",
                "observation": list(range(observed)),
                "achieved_goal": list(self.effector.grip_index),
                "desired_goal": ball,
                "threshold": self.world.shown(self.world.ball_radius),
                "instructive": False,
            },
            {
                "name": "throw",
                "observation": list(range(observed + 4)),
                "achieved_goal": ball,
                "desired_goal": [observed + 4, observed + 5],
                "instructive": True,
            },
        ]

    def state_names(self) -> dict[str, list[int]]:
        """Returns names for entries of the state.

        They are ``hand`` or ``arm`` (all its observed entries), ``grip`` (position of its end), ``ball`` and,
        if the ball is thrown, ``ball_speed`` and ``hole``; besides ``observation`` and ``desired_goal``.
        """
        observed = self.effector.observation_size
        names = {self.task.effector: list(range(observed)), "grip": list(self.effector.grip_index)}
        pairs = ("ball", "ball_speed", "hole") if self.task.throws else ("ball",)
        for place, name in enumerate(pairs):
            names[name] = [observed + 2 * place, observed + 2 * place + 1]
        return names | super().state_names()

    def goal_box(self) -> Box:
        """Returns the box of goals: the screen. A stretched arm reaches up to 0.01 beyond its left side."""
        return [-1.0, -1.0], [1.0, 1.0]

    def picture_box(self) -> Box:
        """Returns the box of a picture: the screen and its margin."""
        edge = 1.0 + 2.0 * MARGIN  # in observed coordinates, the screen is 2 wide
        return [-edge, -edge], [edge, edge]

    def regions(self) -> dict[str, Box]:
        """Returns boxes around all goals (``"goals"``) and the reach of the hand or arm (``"reach"``)."""
        left, bottom, right, top = (2.0 * side - 1.0 for side in self.effector.reach)
        return {
            "goals": (self.goal_distribution.low.tolist(), self.goal_distribution.high.tolist()),
            "reach": ([left, bottom], [right, top]),
        }

    def trail_points(self) -> Tensor:
        """Returns the positions of the balls [N, 2] in meters."""
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
            ValueError: an index is out of range, or a size is too small.
        """
        return render(self, worlds, size=_PICTURE if size is None else size, trail=trail, caption=caption)

    # The state

    @property
    def _keys(self) -> np.ndarray:
        return self._core.keys

    @_keys.setter
    def _keys(self, keys: np.ndarray) -> None:
        self._core.keys = keys

    def load_world_state_dict(self, state: dict[str, Tensor]) -> None:
        self._check_state(state)
        for field in fields(self.worlds):  # copied in place, since the core uses the same memory
            getattr(self.worlds, field.name).copy_(state[field.name])
        self._keys = state["key"].numpy().copy().view(np.uint64)

    # Steps and starts of episodes

    def _check_action(self, action: Tensor) -> None:
        """Does nothing: the core checks actions itself, before anything moves."""

    def _start_episodes(self, which: Tensor) -> None:
        self._core.draw_starts(which.numpy())

    def _advance(self, action: Tensor) -> None:
        command = action.detach() if action.dtype in _OF_NUMPY else action.detach().double()
        self._core.advance(command.numpy())

    def _show(self) -> dict[str, Tensor]:
        return self._tensors(**self._core.show()._asdict())

    def _take(self, action: Tensor) -> dict[str, Tensor]:
        self._advance(action)
        core = self._core
        arrays = core.show()
        entries = self._tensors(**arrays._asdict())
        # Goals are compared in observed coordinates, so that rewards are those of compute_reward.
        if self._native:
            achieved = core.achieved(arrays.achieved_goal, arrays.desired_goal)[:, None]
        else:
            achieved = self._is_achieved(entries).numpy()
        truncated = core.out_of_time()[:, None]
        ends = {"terminated": achieved, "truncated": truncated, "done": achieved | truncated}
        return {
            **entries,
            **self._tensors(reward=reward_of(achieved).astype(core.dtype)),
            **{key: torch.from_numpy(end) for key, end in ends.items()},
        }

    def _tensors(self, **arrays: np.ndarray) -> dict[str, Tensor]:
        """Converts arrays to tensors of the observations' type."""
        tensors = {key: torch.from_numpy(array) for key, array in arrays.items()}
        return tensors if self._native else {key: t.to(self.dtype_shown) for key, t in tensors.items()}


def base_env(env: EnvBase) -> ThrowingEnv:
    """Returns the throwing environment below any transforms.

    Raises:
        TypeError: no throwing environment is found.

    Example:
        >>> from torchrl.envs import StepCounter, TransformedEnv
        >>> from torchrl_her_envs import make_env
        >>> base_env(TransformedEnv(make_env("hand_v1"), StepCounter())).task.name
        'hand_v1'
    """
    return first_below(env, ThrowingEnv, "a ThrowingEnv, transformed or not")


def _as_dtype(dtype: torch.dtype | str) -> torch.dtype:
    """Converts a type or its name to a floating-point type."""
    named = getattr(torch, dtype, None) if isinstance(dtype, str) else dtype
    if not isinstance(named, torch.dtype) or not named.is_floating_point:
        raise ValueError(f"dtype must be a floating-point type such as float32 or float64, got {dtype!r}")
    return named
