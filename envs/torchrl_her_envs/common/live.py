"""Greedy episodes in several environments, one step at a time, with a picture of all of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_her_envs.common.goal_env import choose_indices, goal_env, reward_range
from torchrl_her_envs.common.rendering.colors import FAILURE, SUCCESS
from torchrl_her_envs.common.rendering.pictures import bordered, tile

Policy = Callable[[TensorDictBase], TensorDictBase]


class LiveEpisodes:
    """Plays a greedy episode in each of several environments, step by step.

    When an episode ends, its picture stays, with a green border if the goal was achieved in some step and a
    red border if not. The environment begins a new episode, which is not shown until all shown episodes have
    ended.

    Args:
        env: an environment with goals that gives pictures (``can_render``), transformed or not.
        policy: takes a tensordict and writes the action into it; called for all environments, without
            gradients and with the exploration type ``DETERMINISTIC``.
        worlds: indices of the environments to show; None for all.
        size: longer side of the picture of one environment in pixels.
        columns: pictures in a row; None for a grid that is at least as wide as high.
        trail: whether to draw where the balls were, in throwing tasks.
        caption: a line of text in each picture.

    Attributes:
        frame: the present picture [height, width, 3] of uint8.
        running: indices of the environments whose episodes are not over.
        step_count: steps since the start.

    Raises:
        TypeError: ``env`` has no environment with goals below it.
        ValueError: the environment gives no pictures, or an index is out of range.

    Example:
        >>> from torchrl_her_envs import make_env
        >>> env = make_env("hand_v0", num_envs=3)
        >>> live = LiveEpisodes(env, env.rand_action, size=32)
        >>> live.start(seed=1)
        >>> live.step()
        >>> live.step_count, live.running, live.achieved
        (1, [0, 1, 2], 0)
    """

    frame: Tensor

    def __init__(
        self,
        env: EnvBase,
        policy: Policy,
        *,
        worlds: Sequence[int] | None = None,
        size: int = 240,
        columns: int | None = None,
        trail: bool = True,
        caption: str = "",
    ) -> None:
        base = goal_env(env)
        if not base.can_render:
            raise ValueError(f"{base.task_name} cannot be filmed: it gives no pictures")
        self.running: list[int] = []
        self.step_count = 0
        self._env, self._base, self._policy = env, base, policy
        self._worlds = choose_indices(env.batch_size[0], worlds)
        self._size, self._caption, self._keeps_trail = size, caption, trail
        self._columns = math.ceil(math.sqrt(len(self._worlds))) if columns is None else columns
        self._pictures: dict[int, Tensor] = {}
        self._trail: list[Tensor] = []

    @property
    def achieved(self) -> int:
        """Number of shown environments whose goals are achieved now, or were at the end of their episodes."""
        return int(self._success[self._worlds].sum())

    @property
    def worlds(self) -> int:
        """Number of environments that are shown."""
        return len(self._worlds)

    @property
    def max_steps(self) -> int:
        """Maximum number of steps of an episode."""
        return self._base.max_steps

    @property
    def desired_goal(self) -> Tensor:
        """The goals [N, g] of all environments, as the policy sees them."""
        return self._shown["desired_goal"]

    def start(self, *, seed: int | None = None) -> None:
        """Begins a new episode in all environments.

        Args:
            seed: seed of their starts and goals; None continues the random numbers of the environments.
        """
        if seed is not None:
            self._base.set_seeds([seed])
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            self._shown = self._env.reset()
        self._success = torch.zeros_like(self._shown["done"])
        self.running, self.step_count = list(self._worlds), 0
        self._pictures, self._trail = {}, []
        self._shoot(self._shown["done"])

    def step(self) -> None:
        """Takes a step in all environments; does nothing if all episodes are over."""
        if not self.running:
            return
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            stepped = self._env.step(self._policy(self._shown))
            after = stepped["next"]
            self.step_count += 1
            out_of_time = self.step_count == self._base.max_steps  # needed if transforms override the ends
            self._success[self.running] = self._achieved(after)[self.running]
            self._shoot(after["done"] | out_of_time)
            if self.running:
                self._shown = self._env.maybe_reset(self._env.step_mdp(stepped))

    def _achieved(self, after: TensorDictBase) -> Tensor:
        """Returns whether goals are achieved after a step, [N, 1], by the environment's flag or reward."""
        word = after.get("is_success", None)
        if word is not None:
            return word
        info = [after] if self._base.info_keys else []
        reward = self._base.compute_reward(after["achieved_goal"], after["desired_goal"], *info)
        return reward >= reward_range(self._base)[1]

    def _shoot(self, done: Tensor) -> None:
        """Renders the picture, and stops the environments that are ``done`` [N, 1]."""
        env, running = self._base, self.running
        drawn = env.render(running, size=self._size, trail=self._trail, caption=self._caption)
        for world, picture in zip(running, drawn, strict=True):
            color = SUCCESS if self._success[world] else FAILURE
            self._pictures[world] = bordered(picture, color) if done[world] else picture
        self.running = [world for world in running if not done[world]]
        points = env.trail_points() if self._keeps_trail else None
        if points is not None:
            self._trail.append(points)
        self.frame = tile([self._pictures[world] for world in self._worlds], columns=self._columns)
