"""Sets the reward of failures: ends of an episode without its goal, for instance by a fall or a crash."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torchrl.envs import Transform

from torchrl_her.goals.rewards import RewardFunction, is_achieved


class Failures(Transform):
    """Changes the reward of failures (ends of an episode without its goal), or truncates episodes there.

    If each step has a reward of -1, failing early can give the best return. This is avoided if the reward of
    a failure is the return of never achieving the goal, ``missed_reward / (1 - gamma)``. Relabeling keeps the
    reward of a failure, so the same is true for virtual goals.

    Args:
        worth: the reward of a failure; None to truncate the episode without changing the reward.
        reward_fn: decides if a goal is achieved, see :func:`~torchrl_her.goals.is_achieved`.
    """

    def __init__(self, worth: float | None, reward_fn: RewardFunction) -> None:
        super().__init__()
        self.worth, self.reward_fn = worth, reward_fn

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        terminated = next_tensordict.get("terminated")
        if not bool(terminated.any()):
            return next_tensordict
        achieved = is_achieved(next_tensordict, self.reward_fn).view(terminated.shape)
        failed = terminated & ~achieved
        if self.worth is None:
            next_tensordict.set("terminated", terminated & achieved)
            next_tensordict.set("truncated", next_tensordict.get("truncated") | failed)
        else:
            reward = next_tensordict.get("reward")
            next_tensordict.set("reward", torch.where(failed, self.worth, reward))
        return next_tensordict
