"""The reward of failures, which end an episode before its goal is achieved, as a fall or a crash does."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.envs import Transform

from torchrl_her.goals.rewards import is_achieved


class Failures(Transform):
    """Sets the reward of a failure, a step that ends an episode without its goal, or truncates there.

    With a reward of -1 for each step, failing soon can give the best return. It never does if the reward of
    a failure is the return of never achieving the goal, ``missed_reward / (1 - gamma)``. Relabeling keeps
    what a failure costs, so this holds for virtual goals, too.

    Args:
        worth: the reward of a failure; None to truncate the episode there, with the reward as it is.
        judged_by: options of :func:`~torchrl_her.goals.is_achieved`.
    """

    def __init__(self, worth: float | None, judged_by: dict[str, Any]) -> None:
        super().__init__()
        self.worth, self.judged_by = worth, judged_by

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        terminated = next_tensordict.get("terminated")
        if not bool(terminated.any()):
            return next_tensordict
        achieved = is_achieved(next_tensordict, **self.judged_by).view(terminated.shape)
        failed = terminated & ~achieved
        if self.worth is None:
            next_tensordict.set("terminated", terminated & achieved)
            next_tensordict.set("truncated", next_tensordict.get("truncated") | failed)
        else:
            reward = next_tensordict.get("reward")
            next_tensordict.set("reward", torch.where(failed, self.worth, reward))
        return next_tensordict
