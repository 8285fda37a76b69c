"""Any of gymnasium's environments with goals as a batched TorchRL environment."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack, closing
from functools import partial
from typing import Any, cast

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import GymWrapper

from torchrl_her_envs.common.goal_env import TaskTraits, choose_indices
from torchrl_her_envs.common.rendering.pictures import captioned, resized
from torchrl_her_envs.common.seeding import as_seeds, block_keys
from torchrl_her_envs.gym.check import (
    KEYS,
    METHODS,
    check_goal_env,
    goals_to_try,
    make_one,
    shown_of,
    spec_of,
)
from torchrl_her_envs.gym.goal_functions import GoalFunction


def make_gym_env(
    id: str,
    *,
    num_envs: int = 1,
    seed: int | Sequence[int] = 0,
    max_steps: int | None = None,
    parallel: bool = False,
    **options: Any,
) -> GymGoalEnv:
    """Makes a batch of a gymnasium environment that follows GoalEnv.

    Args:
        id: as ``gymnasium.make`` takes it, ``module:Env-v0`` included. The environments of
            gymnasium-robotics need no import.
        num_envs: number of environments.
        seed: of all environments; R seeds for R equal blocks of them, each as if alone.
        max_steps: length of an episode; the environment's own if None.
        parallel: a process for each environment, which pays where a step takes milliseconds and there are
            several cores.
        options: for the environment, as ``gymnasium.make`` takes them (``render_mode``, for instance).

    Raises:
        ValueError: there is no such environment, it does not take an option, it lacks something that GoalEnv
            asks for, it has no time limit, or environments cannot be shared out among the seeds.
        ImportError: a package that it needs is not installed.

    Example:
        >>> env = make_gym_env("torchrl_her_envs:torchrl_her/HandReach-v0", num_envs=2, seed=0)
        >>> env.rollout(3)["desired_goal"].shape
        torch.Size([2, 3, 2])
        >>> env.close()
    """
    if num_envs < 1:
        raise ValueError(f"num_envs must be at least 1, got {num_envs}")
    if max_steps is not None:
        options["max_episode_steps"] = max_steps
    with ExitStack() as opened:
        reference_env = opened.enter_context(closing(make_one(id, options)))
        check_goal_env(id, reference_env)
        # By its spec rather than its id: new processes then need neither register it nor load TorchRL.
        make = partial(
            gymnasium.make, gymnasium.registry[spec_of(reference_env).id], disable_env_checker=True, **options
        )
        vector = AsyncVectorEnv if parallel else SyncVectorEnv
        envs = opened.enter_context(closing(vector([make] * num_envs, autoreset_mode=AutoresetMode.DISABLED)))
        env = GymGoalEnv(envs, reference_env, seed=seed)
        opened.pop_all()  # from here on GymGoalEnv.close closes them
    return env


class GymGoalEnv(TaskTraits, GymWrapper):
    """N environments of gymnasium's with goals, stepped by gymnasium and wrapped by TorchRL.

    Keys: ``observation``, ``achieved_goal``, ``desired_goal`` and ``reward`` in float32, ``action``
    (float32 within the environment's bounds, or whole numbers [N]), ``terminated``, ``truncated``, ``done``.
    The environments are independent: environment k with a given seed does the same in every batch.

    :func:`make_gym_env` makes them.

    Args:
        envs: gymnasium's vector of them, which must not reset by itself (``AutoresetMode.DISABLED``).
        reference_env: one more of the same, whose functions give the rewards of goals.
        seed: of all environments; R seeds for R equal blocks of them, each as if alone.

    Attributes:
        achieved_reward: the reward of an achieved goal.
        missed_reward: the reward of a goal that is far away; a sparse reward is always one of these two.

    Raises:
        ValueError: environments cannot be shared out among the seeds, or an achieved goal gives no more
            reward than a missed one.
    """

    def __init__(
        self, envs: VectorEnv, reference_env: gymnasium.Env, *, seed: int | Sequence[int] = 0, **kwargs: Any
    ) -> None:
        super().__init__(envs, device="cpu", **kwargs)  # TorchRL's metaclass adds some
        self._reference_env = reference_env
        self._goal_dtype = shown_of(reference_env.observation_space)["achieved_goal"].dtype
        self._limit = spec_of(reference_env).max_episode_steps or 0
        id, goals = spec_of(reference_env).id, goals_to_try(reference_env)
        self._reward_of, self._terminated_of = (
            GoalFunction(reference_env.get_wrapper_attr(name), *goals, name=f"{id}'s {name}")
            for name in METHODS
        )
        self.missed_reward, self.achieved_reward = (self._reward_of.tried[:2] + 0.0).tolist()  # never -0.0
        if not self.missed_reward < self.achieved_reward:
            raise ValueError(
                f"{id}: a goal that is met gives {self.achieved_reward}, one far away {self.missed_reward}; "
                f"that must be less (are all goals met from the start?)"
            )
        self.set_seeds(as_seeds(seed))

    @property
    def task_name(self) -> str:
        return f"gym:{spec_of(self._reference_env).id}"

    @property
    def can_render(self) -> bool:
        """Whether it was made with ``render_mode="rgb_array"``."""
        return self._reference_env.render_mode == "rgb_array"

    @property
    def max_steps(self) -> int:
        """Steps after which an episode is truncated."""
        return self._limit

    def compute_reward(self, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
        """The reward of having achieved one goal when another was desired, by the environment's own rule.

        Args:
            achieved_goal: [..., g].
            desired_goal: [..., g], broadcast against it.

        Returns:
            [..., 1] of float32.
        """
        return self._ask(self._reward_of, achieved_goal, desired_goal).float()

    def compute_terminated(self, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
        """Whether the environment ends an episode there: [..., 1] of bool."""
        return self._ask(self._terminated_of, achieved_goal, desired_goal).bool()

    def set_seeds(self, seeds: Sequence[int]) -> None:
        """Seeds R equal blocks of environments, each as if it were alone; from their next reset on.

        Args:
            seeds: R of them.

        Raises:
            ValueError: the environments cannot be shared out among R blocks, or a seed is out of range.
        """
        # Some environments hand their seed to generators that take 32 bits.
        self._next_seeds: list[int | None] = (block_keys(seeds, self.batch_size[0]) >> np.uint64(33)).tolist()

    def render(
        self,
        worlds: int | Sequence[int] | None = None,
        *,
        size: int | None = None,
        trail: Sequence[Tensor] = (),
        caption: str = "",
    ) -> Tensor:
        """Pictures of the environments as they are now; they must be made with ``render_mode="rgb_array"``.

        Args:
            worlds: an index, several, or None for all environments of the batch.
            size: of the longer side of each picture in pixels; as the environment draws it if None.
            trail: not used.
            caption: a line of text in each picture.

        Returns:
            Pictures [len(worlds), height, width, 3] of uint8; without the first dimension for one index.

        Raises:
            ValueError: they were made without pictures, or an index is out of range.
        """
        if not self.can_render:
            mode = self._reference_env.render_mode
            raise ValueError(f'pictures need render_mode="rgb_array", got {mode!r}')
        chosen = choose_indices(self.batch_size[0], worlds)
        if isinstance(self._env, SyncVectorEnv):
            drawn = [self._env.envs[index].render() for index in chosen]
        else:  # in other processes, which all draw at once
            everything = self._env.render()
            drawn = [everything[index] for index in chosen]
        pictures = [torch.from_numpy(np.array(picture)) for picture in drawn]
        if size is not None:
            pictures = [resized(picture, size) for picture in pictures]
        pictures = [captioned(picture, caption) for picture in pictures]
        return pictures[0] if isinstance(worlds, int) else torch.stack(pictures)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Closes all environments."""
        self._reference_env.close()
        super().close(raise_if_closed=raise_if_closed)

    def _ask(self, function: GoalFunction, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
        """A function's answers [..., 1]."""
        pair = torch.broadcast_tensors(achieved_goal, desired_goal)
        achieved, desired = (self._rows(goals) for goals in pair)
        answers = torch.from_numpy(function(achieved, desired))
        return answers.to(pair[0].device).view(*pair[0].shape[:-1], 1)

    def _rows(self, goals: Tensor) -> np.ndarray:
        """Goals [..., g] as rows of the environment's type; copies, as its functions may write into them."""
        return goals.detach().cpu().reshape(-1, goals.shape[-1]).numpy().astype(self._goal_dtype)

    # TorchRL's hooks

    def _make_specs(self, env: VectorEnv, batch_size: torch.Size | None = None) -> None:
        n, space, shown = env.num_envs, env.single_action_space, shown_of(env.single_observation_space)
        seen = {key: Unbounded(shape=(n, *(shown[key].shape or ())), dtype=torch.float32) for key in KEYS}
        self.observation_spec = Composite(seen, shape=(n,))
        if isinstance(space, spaces.Discrete):
            self.action_spec = Categorical(n=int(space.n), shape=(n,), dtype=torch.int64)
        else:
            box = cast(spaces.Box, space)
            low, high = (torch.as_tensor(side).float().expand(n, *box.shape) for side in (box.low, box.high))
            self.action_spec = Bounded(low=low, high=high, shape=low.shape, dtype=torch.float32)
        self.reward_spec = Unbounded(shape=(n, 1), dtype=torch.float32)
        self.done_spec = self._make_done_spec()

    def read_action(self, action: Tensor) -> np.ndarray:
        """Actions as gymnasium takes them: its whole numbers need not start at 0."""
        first = getattr(self._env.single_action_space, "start", 0)
        return super().read_action(action) + first

    def read_obs(self, observations: dict[str, Any]) -> dict[str, Any]:
        """Observation and goals, in float32; further keys that the environment may show are left out."""
        return super().read_obs({key: observations[key] for key in KEYS})

    def _set_seed(self, seed: int | None) -> None:
        self.set_seeds([seed or 0])

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        which = np.ones(self.batch_size, np.bool_) if mask is None else mask.view(-1).numpy()
        options = {"options": {"reset_mask": which}} if not which.all() else {}
        observations, _ = self._env.reset(seed=self._next_seeds, **options)
        self._next_seeds = [
            None if reset else seed for reset, seed in zip(which, self._next_seeds, strict=True)
        ]
        return TensorDict(self.read_obs(observations), batch_size=self.batch_size, device=self.device)
