"""Any gymnasium environment with goals as a batched TorchRL environment."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from contextlib import ExitStack, closing
from functools import partial
from numbers import Integral
from typing import Any, cast

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import GymWrapper

from torchrl_her_envs.goal_functions import GoalFunction
from torchrl_her_envs.seeding import block_keys

_KEYS = ("observation", "achieved_goal", "desired_goal")
_METHODS = ("compute_reward", "compute_terminated")
_EPISODES = 8  # whose goals the environment's functions are tried with


def make_gym_env(
    id: str,
    *,
    num_envs: int = 1,
    seed: int | Sequence[int] = 0,
    max_steps: int | None = None,
    parallel: bool = False,
    **options: Any,
) -> GymGoalEnv:
    """Makes a batch of worlds of a gymnasium environment that follows GoalEnv.

    Args:
        id: as ``gymnasium.make`` takes it, ``module:Env-v0`` included. Those of gymnasium-robotics need
            no import.
        num_envs: number of worlds.
        seed: of all worlds; R seeds for R equal blocks of worlds, each as if alone.
        max_steps: length of an episode; the environment's own if None.
        parallel: a process for each world, which pays where a step takes milliseconds and there are cores.
        options: for the environment, as ``gymnasium.make`` takes them (``render_mode``, for instance).

    Raises:
        ValueError: there is no such environment, it lacks something that GoalEnv asks for, it has no
            time limit, or worlds cannot be shared out among the seeds.
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
        judge = opened.enter_context(closing(_make_one(id, options)))
        _check(id, judge)
        # By what gymnasium knows of it: a new process need neither register anything nor load TorchRL.
        make = partial(
            gymnasium.make, gymnasium.registry[_spec(judge).id], disable_env_checker=True, **options
        )
        vector = AsyncVectorEnv if parallel else SyncVectorEnv
        worlds = opened.enter_context(
            closing(vector([make] * num_envs, autoreset_mode=AutoresetMode.DISABLED))
        )
        env = GymGoalEnv(worlds, judge, seed=seed)
        opened.pop_all()  # closed only where something went wrong
    return env


class GymGoalEnv(GymWrapper):
    """N worlds of a gymnasium environment with goals, stepped by gymnasium and wrapped by TorchRL.

    Keys: ``observation``, ``achieved_goal``, ``desired_goal`` and ``reward`` in float32, ``action``
    (float32 within the environment's bounds, or whole numbers [N]), ``terminated``, ``truncated``, ``done``.
    Worlds are independent: world k with a given seed does the same in every batch.

    :func:`make_gym_env` makes them.

    Args:
        worlds: of gymnasium, without resets of their own (``AutoresetMode.DISABLED``).
        judge: one more of the same, whose functions say what a goal is worth.
        seed: of all worlds; R seeds for R equal blocks of worlds, each as if alone.

    Attributes:
        achieved_reward: the reward of an achieved goal.
        missed_reward: that of a goal that is far away; a sparse reward is one of the two.

    Raises:
        ValueError: worlds cannot be shared out among the seeds.
    """

    def __init__(
        self, worlds: VectorEnv, judge: gymnasium.Env, *, seed: int | Sequence[int] = 0, **kwargs: Any
    ) -> None:
        super().__init__(worlds, device="cpu", **kwargs)  # TorchRL's metaclass adds some
        self._judge = judge
        self._goal_dtype = _shown(judge.observation_space)["achieved_goal"].dtype
        self._limit = _spec(judge).max_episode_steps or 0
        id, goals = _spec(judge).id, _goals_to_try(judge)
        self._reward_of, self._terminated_of = (
            GoalFunction(judge.get_wrapper_attr(name), *goals, name=f"{id}'s {name}") for name in _METHODS
        )
        self.missed_reward, self.achieved_reward = (self._reward_of.tried[:2] + 0.0).tolist()  # never -0.0
        self.set_seeds([int(seed)] if isinstance(seed, int | Integral) else list(seed))

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
        return self._judged(self._reward_of, achieved_goal, desired_goal).float()

    def compute_terminated(self, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
        """Whether the environment ends an episode there: [..., 1] of bool."""
        return self._judged(self._terminated_of, achieved_goal, desired_goal).bool()

    def set_seeds(self, seeds: Sequence[int]) -> None:
        """Seeds R equal blocks of worlds, each as if it were alone; from their next reset on.

        Args:
            seeds: R of them.

        Raises:
            ValueError: the worlds cannot be shared out among R blocks, or a seed is out of range.
        """
        # Some environments hand their seed to generators that take 32 bits.
        self._next_seeds: list[int | None] = (block_keys(seeds, self.batch_size[0]) >> np.uint64(33)).tolist()

    def render(self) -> Tensor:
        """Pictures of all worlds, [N, height, width, 3] of uint8; made with ``render_mode="rgb_array"``.

        Raises:
            ValueError: made without.
        """
        if self._judge.render_mode != "rgb_array":
            raise ValueError(f'pictures need render_mode="rgb_array", got {self._judge.render_mode!r}')
        return torch.from_numpy(np.stack(self._env.render()))

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Closes all worlds."""
        self._judge.close()
        super().close(raise_if_closed=raise_if_closed)

    def _judged(self, function: GoalFunction, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
        """A function's answers [..., 1]."""
        pair = torch.broadcast_tensors(achieved_goal, desired_goal)
        achieved, desired = (self._rows(goals) for goals in pair)
        answers = torch.from_numpy(function(achieved, desired))
        return answers.to(pair[0].device).view(*pair[0].shape[:-1], 1)

    def _rows(self, goals: Tensor) -> np.ndarray:
        """Goals [..., g] as rows of the environment's own type: copies, which its functions may write into."""
        return goals.detach().cpu().reshape(-1, goals.shape[-1]).numpy().astype(self._goal_dtype)

    # TorchRL's hooks

    def _make_specs(self, env: VectorEnv, batch_size: torch.Size | None = None) -> None:
        n, space, shown = env.num_envs, env.single_action_space, _shown(env.single_observation_space)
        seen = {key: Unbounded(shape=(n, *(shown[key].shape or ())), dtype=torch.float32) for key in _KEYS}
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
        """Actions as gymnasium takes them; whole numbers may start elsewhere than at 0 there."""
        first = getattr(self._env.single_action_space, "start", 0)
        return super().read_action(action) + first

    def read_obs(self, observations: dict[str, Any]) -> dict[str, Any]:
        """What GoalEnv asks for of what the environment shows, in float32."""
        return super().read_obs({key: observations[key] for key in _KEYS})

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


def _spec(env: gymnasium.Env) -> EnvSpec:
    return cast(EnvSpec, env.spec)  # None only where gymnasium.make was not asked


def _shown(space: spaces.Space) -> spaces.Dict:
    return cast(spaces.Dict, space)  # _check sees to it


def _make_one(id: str, options: dict[str, Any]) -> gymnasium.Env:
    """One world, with a message of one line where that fails."""
    hint = _register_robotics(id)
    try:
        return gymnasium.make(id, disable_env_checker=True, **options)
    except (gymnasium.error.DependencyNotInstalled, ImportError) as error:
        raise ImportError(f"cannot make the gymnasium environment {id!r}: {_line(error)}") from error
    except gymnasium.error.Error as error:
        raise ValueError(f"cannot make the gymnasium environment {id!r}: {_line(error)}{hint}") from error


def _register_robotics(id: str) -> str:
    """Lets gymnasium know the environments of gymnasium-robotics; what to say if they are not installed."""
    if ":" not in id and id not in gymnasium.registry:
        try:
            importlib.import_module("gymnasium_robotics")
        except ModuleNotFoundError:
            return " (gymnasium-robotics is not installed: pip install 'torchrl-her[robotics]')"
    return ""


def _line(error: Exception) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__


def _check(id: str, env: gymnasium.Env) -> None:
    """Raises a ValueError that names what an environment lacks of GoalEnv."""
    shown = env.observation_space
    if not isinstance(shown, spaces.Dict):
        raise ValueError(f"{id} shows no dict of {', '.join(_KEYS)}, but a {type(shown).__name__}")
    for key in _KEYS:
        if key not in shown.spaces:
            raise ValueError(f"{id} lacks {key!r} in what it shows: {', '.join(shown.spaces)}")
        if len(shown[key].shape or ()) != 1:
            raise ValueError(f"{id} must show {key!r} as a row of numbers, got {shown[key]}")
    if shown["achieved_goal"].shape != shown["desired_goal"].shape:
        sizes = [shown[key].shape for key in _KEYS[1:]]
        raise ValueError(
            f"{id}'s achieved and desired goals must have one shape, got {sizes[0]} and {sizes[1]}"
        )
    for name in _METHODS:
        if not env.has_wrapper_attr(name):
            raise ValueError(
                f"{id} lacks the method {name!r}, which tells what another goal would have given"
            )
    if not isinstance(env.action_space, spaces.Box | spaces.Discrete):
        raise ValueError(f"{id}'s actions must be a Box or Discrete, got {env.action_space}")
    if isinstance(env.action_space, spaces.Box) and not env.action_space.is_bounded():
        raise ValueError(f"{id}'s actions must have bounds, got {env.action_space}")
    if _spec(env).max_episode_steps is None:
        raise ValueError(f"{id} has no time limit: give max_steps")


def _goals_to_try(env: gymnasium.Env) -> tuple[np.ndarray, np.ndarray]:
    """Achieved and desired goals [M, g] of real episodes: one missed by far, then some that are met."""
    shown = [env.reset(seed=seed)[0] for seed in range(_EPISODES)]
    achieved, desired = (np.stack([own[key] for own in shown]) for key in _KEYS[1:])
    gap = np.abs(achieved[:, None].astype(np.float64) - desired).sum(-1)
    here, there = np.unravel_index(gap.argmax(), gap.shape)
    met = 3 if achieved.shape[1] == 3 else 2  # as many pairs as numbers in a goal would tell less
    return (
        np.concatenate([achieved[here, None], desired[:met]]),
        np.concatenate([desired[there, None], desired[:met]]),
    )
