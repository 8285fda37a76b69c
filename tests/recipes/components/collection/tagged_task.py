"""A task whose observations tell which environment, episode and step they are of, and the action before."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

TASK = f"{__name__}:TaggedTask"
LENGTH = 7  # steps of an episode that does not achieve its goal
_BLOCKS = 997


def block_of(seed: int) -> int:
    """The number that environments with this seed show."""
    return seed % _BLOCKS


def wanted(block: Tensor, place: Tensor, episode: Tensor) -> Tensor:
    """Real goals [..., 4]; those of every third episode are achieved in its third step, and end it."""
    step = torch.where((place + episode) % 3 == 0, 3.0, -5.0)
    return torch.stack((block, place, episode, step + 0.25), -1)


class TaggedTask(EnvBase):
    """Observations [N, 5]: number of the block (:func:`block_of`), place in it, episode, step, last action.

    Args:
        num_envs: N.
        seed: of R equal blocks.
        fails_at: the number of its step that raises an error.
        only_in: id of the only process in which it can be made; of all if None.

    Raises:
        ValueError: it is made in another process.
    """

    max_steps = LENGTH

    def __init__(
        self,
        num_envs: int,
        seed: int | Sequence[int] = 0,
        fails_at: int | None = None,
        only_in: int | None = None,
    ) -> None:
        if only_in not in (None, os.getpid()):
            raise ValueError("there is no display")
        super().__init__(batch_size=[num_envs])
        self.fails_at, self._taken = fails_at, 0
        goal = Unbounded((num_envs, 4))
        seen = {"achieved_goal": goal, "desired_goal": goal.clone(), "observation": Unbounded((num_envs, 5))}
        self.observation_spec = Composite(seen, shape=(num_envs,))
        self.action_spec = Bounded(-1.0, 1.0, (num_envs, 1))
        self.reward_spec = Unbounded((num_envs, 1))
        self.set_seeds([seed] if isinstance(seed, int) else seed)

    def set_seeds(self, seeds: Sequence[int]) -> None:
        each = self.batch_size[0] // len(seeds)
        self._block = torch.tensor([block_of(seed) for seed in seeds]).float().repeat_interleave(each)
        self._place = torch.arange(each).float().repeat(len(seeds))
        self._episode, self._steps = torch.full_like(self._place, -1), torch.zeros_like(self._place)
        self._action = torch.zeros(*self.batch_size, 1)

    def compute_reward(self, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
        return -((achieved_goal - desired_goal).abs().amax(-1, keepdim=True) >= 0.4).float()

    def _set_seed(self, seed: int | None) -> None:
        self.set_seeds([seed or 0])

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        which = torch.ones(self.batch_size).bool() if mask is None else mask.view(-1)
        self._episode = self._episode + which
        self._steps = self._steps.masked_fill(which, 0)
        self._action = self._action.masked_fill(which.unsqueeze(-1), 0)
        return TensorDict(self._shown(), self.batch_size)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._taken += 1
        if self._taken == self.fails_at:
            raise ValueError("this environment breaks now")
        self._steps, self._action = self._steps + 1, tensordict["action"].clone()
        shown = self._shown()
        reward = self.compute_reward(shown["achieved_goal"], shown["desired_goal"])
        ends = reward == 0
        return TensorDict({**shown, "reward": reward, "done": ends, "terminated": ends}, self.batch_size)

    def _shown(self) -> dict[str, Tensor]:
        tag = torch.stack((self._block, self._place, self._episode, self._steps), -1)
        goal = wanted(self._block, self._place, self._episode)
        return {"observation": torch.cat((tag, self._action), -1), "achieved_goal": tag, "desired_goal": goal}
