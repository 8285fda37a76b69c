"""Films of a policy at work in several environments at once."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_her_envs.common.goal_env import GoalEnv, choose_indices, goal_env, reward_range
from torchrl_her_envs.common.rendering.colors import FAILURE, SUCCESS
from torchrl_her_envs.common.rendering.pictures import bordered, tile

Policy = Callable[[TensorDictBase], TensorDictBase]


def record_episodes(
    env: EnvBase,
    policy: Policy,
    *,
    worlds: Sequence[int] | None = None,
    size: int = 240,
    columns: int | None = None,
    trail: bool = True,
    hold: int = 25,
    caption: str = "",
    achieved_reward: float | None = None,
) -> list[Tensor]:
    """Plays one greedy episode in each of several environments and films them side by side.

    All environments are reset before. The picture of an environment whose episode is over stays as it was,
    with a green border if it achieved its goal in some step and a red one if not. The environment itself
    begins a new episode, which is not filmed, as long as others are.

    Args:
        env: an environment with goals that gives pictures (``can_render``), transformed or not.
        policy: takes a tensordict and writes the action into it; called for all environments, without
            gradients and with the exploration type ``DETERMINISTIC``.
        worlds: indices of the environments to film; None for all.
        size: longer side of the picture of one environment in pixels.
        columns: pictures in a row; None for a grid that is at least as wide as high.
        trail: whether to draw where the balls were, in throwing tasks.
        hold: how many times the last frame is repeated: 25 are one second at 25 frames a second.
        caption: a line of text in each picture.
        achieved_reward: the least reward of an achieved goal; the environment's own if None.

    Returns:
        Frames [height, width, 3] of uint8: the start, one for each step, and the last one repeated.

    Raises:
        TypeError: ``env`` has no environment with goals below it.
        ValueError: it gives no pictures, an index is out of range, ``size`` is too small, or ``columns`` is
            below 1.

    Example:
        >>> from torchrl_her_envs import make_env
        >>> env = make_env("hand_v0", num_envs=3)
        >>> frames = record_episodes(env, env.rand_action, size=32, hold=0)
        >>> frames[0].shape  # a grid of 2 by 2, of which three are used
        torch.Size([64, 64, 3])
    """
    base = goal_env(env)
    if not base.can_render:
        raise ValueError(f"{base.task_name} cannot be filmed: it gives no pictures")
    chosen = choose_indices(env.batch_size[0], worlds)
    achieved = reward_range(base)[1] if achieved_reward is None else achieved_reward
    film = _Film(base, chosen, size=size, columns=columns, trail=trail, caption=caption)
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        tensordict = env.reset()
        success = torch.zeros_like(tensordict["done"])
        film.shoot(done=tensordict["done"], success=success)
        for step in range(1, base.max_steps + 1):
            tensordict = env.step(policy(tensordict))
            after = tensordict["next"]
            out_of_time = step == base.max_steps  # whatever the transforms say
            success = success | (after["reward"] >= achieved)
            film.shoot(done=after["done"] | out_of_time, success=success)
            if not film.running:
                break
            tensordict = env.maybe_reset(env.step_mdp(tensordict))
    return film.frames + film.frames[-1:] * hold


class _Film:
    """The frames so far, the latest picture of each environment, and which environments still run."""

    def __init__(
        self,
        env: GoalEnv,
        worlds: list[int],
        *,
        size: int,
        columns: int | None,
        trail: bool,
        caption: str,
    ) -> None:
        self.frames: list[Tensor] = []
        self.running = worlds
        self._env, self._size, self._caption = env, size, caption
        self._columns = math.ceil(math.sqrt(len(worlds))) if columns is None else columns
        self._pictures: dict[int, Tensor] = {}
        self._trail: list[Tensor] = []
        self._keeps_trail = trail

    def shoot(self, *, done: Tensor, success: Tensor) -> None:
        """Adds a frame, and stops the environments that are ``done`` [N, 1] with their ``success`` [N, 1]."""
        env, running = self._env, self.running
        drawn = env.render(running, size=self._size, trail=self._trail, caption=self._caption)
        for world, picture in zip(running, drawn, strict=True):
            color = SUCCESS if success[world] else FAILURE
            self._pictures[world] = bordered(picture, color) if done[world] else picture
        self.running = [world for world in running if not done[world]]
        points = env.trail_points() if self._keeps_trail else None
        if points is not None:
            self._trail.append(points)
        self.frames.append(tile(list(self._pictures.values()), columns=self._columns))
