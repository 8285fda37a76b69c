"""Tasks for studies whose lengths are multiplied by a factor, to test if training depends on their unit."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs import EnvBase

from torchrl_her_envs.common.goal_env import GoalEnv, goal_env
from torchrl_her_envs.registry import make_env

_LENGTHS = ("observation", "achieved_goal", "desired_goal")


class InUnits(GoalEnv):
    """Wrapper that multiplies observations and goals of environments by a factor, but not actions.

    Args:
        env: environments from :func:`~torchrl_her_envs.make_env`.
        factor: the factor, which also scales the distance below which a goal is achieved.
    """

    def __init__(self, env: EnvBase, factor: float) -> None:
        super().__init__(device=env.device, batch_size=env.batch_size)
        self.env, self.factor = env, factor
        task = self.task = goal_env(env)
        self.max_steps = task.max_steps
        specs = {key: Unbounded(shape=env.observation_spec[key].shape) for key in _LENGTHS}
        self.observation_spec = Composite(specs, shape=env.batch_size)
        self.action_spec = env.action_spec.clone()
        self.reward_spec = env.reward_spec.clone()
        self.done_spec = env.full_done_spec.clone()
        for name in ("missed_reward", "achieved_reward", "dense_reward"):
            setattr(self, name, getattr(task, name))

    @property
    def task_name(self) -> str:
        return f"{self.task.task_name} times {self.factor:g}"

    @property
    def batched(self) -> bool:
        return self.task.batched

    def compute_reward(self, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
        """Computes the task's rewards [..., 1] from multiplied goals [..., g]."""
        return self.task.compute_reward(achieved_goal / self.factor, desired_goal / self.factor)

    def compute_terminated(self, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
        """Computes whether the task terminates an episode, [..., 1], from multiplied goals [..., g]."""
        return self.task.compute_terminated(achieved_goal / self.factor, desired_goal / self.factor)

    def set_seeds(self, seeds: Any) -> None:
        self.task.set_seeds(seeds)

    def _set_seed(self, seed: int | None) -> None:
        self.task.set_seeds([seed or 0])

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        return self._multiplied(self.env._reset(tensordict, **kwargs))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self._multiplied(self.env._step(tensordict))

    def _multiplied(self, tensordict: TensorDictBase) -> TensorDictBase:
        kept = tensordict.exclude("state")
        return kept.update({key: kept[key] * self.factor for key in _LENGTHS})


def in_units(
    task: str, factor: float, *, num_envs: int = 1, seed: Any = 0, dtype: torch.dtype = torch.float32
) -> InUnits:
    """Makes environments of a task whose observations and goals are multiplied by ``factor``.

    Example:
        >>> env = in_units("hand_v1", 1_000.0, num_envs=2)
        >>> bool(env.reset()["desired_goal"].abs().max() > 10)
        True
    """
    options = {} if dtype == torch.float32 else {"dtype": dtype}
    return InUnits(make_env(task, num_envs=num_envs, seed=seed, **options), factor)
