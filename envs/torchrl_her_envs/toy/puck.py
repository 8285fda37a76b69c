"""A task for studies: a puck with momentum must stop at its goal, since episodes do not end there."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

_FORCE = 0.02  # largest change of velocity in a step; the unit of length is half the table's width
_NEAR = 0.1  # distance below which the goal is achieved, in the same unit


class Puck(EnvBase):
    """N environments in which an action pushes a puck over a table without friction; the edges stop the puck.

    An episode has 50 steps and begins at rest. Starts and goals are uniform on the table [-1, 1]². Episodes
    do not end at the goal, so a puck that arrives too fast slides past it.

    Args:
        num_envs: N, the number of environments.
        seed: Seed of all starts and goals, or R seeds for R equal blocks of environments.

    Example:
        >>> env = Puck(num_envs=2, seed=0)
        >>> at_rest = env.reset()
        >>> pushed = env.step(at_rest.set("action", torch.ones(2, 2)))["next"]
        >>> pushed["observation"][:, 2:].tolist()  # the velocity
        [[0.019999999552965164, 0.019999999552965164], [0.019999999552965164, 0.019999999552965164]]
    """

    max_steps = 50

    def __init__(self, num_envs: int = 1, seed: int | Sequence[int] = 0) -> None:
        super().__init__(device="cpu", batch_size=(num_envs,))
        widths = {"observation": 4, "achieved_goal": 2, "desired_goal": 2}
        self.observation_spec = Composite(
            {key: Unbounded(shape=(num_envs, width)) for key, width in widths.items()}, shape=(num_envs,)
        )
        self.action_spec = Bounded(-1.0, 1.0, shape=(num_envs, 2))
        self.reward_spec = Unbounded(shape=(num_envs, 1))
        self.done_spec = Composite(
            {key: Binary(1, shape=(num_envs, 1), dtype=torch.bool) for key in ("done", "terminated")},
            shape=(num_envs,),
        )
        self.place, self.velocity, self.goal = torch.zeros(3, num_envs, 2)
        self.set_seeds([seed] if isinstance(seed, int) else seed)

    def compute_reward(self, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
        """Returns rewards [..., 1]: 0 if the goals [..., 2] are closer than 0.1, else -1."""
        near = (achieved_goal - desired_goal).norm(dim=-1, keepdim=True) < _NEAR
        return near.float() - 1.0

    def set_seeds(self, seeds: Sequence[int]) -> None:
        """Seeds R equal blocks of environments, each with a random generator of its own."""
        self._generators = [torch.Generator().manual_seed(seed) for seed in seeds]

    def _set_seed(self, seed: int | None) -> None:
        self.set_seeds([seed or 0])

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        begins = torch.ones(*self.batch_size, 1, dtype=torch.bool) if mask is None else mask.view(-1, 1)
        count = len(begins) // len(self._generators)
        drawn = torch.zeros(len(begins), 4)
        for block, generator in enumerate(self._generators):
            rows = slice(block * count, (block + 1) * count)
            if begins[rows].any():  # blocks draw only for their own resets, so they are independent
                drawn[rows].uniform_(-1.0, 1.0, generator=generator)
        self.place = torch.where(begins, drawn[:, :2], self.place)
        self.goal = torch.where(begins, drawn[:, 2:], self.goal)
        self.velocity = self.velocity.masked_fill(begins, 0.0)
        return self._shown()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.velocity = self.velocity + _FORCE * tensordict["action"].clamp(-1.0, 1.0)
        moved = self.place + self.velocity
        self.place = moved.clamp(-1.0, 1.0)
        self.velocity = torch.where(moved == self.place, self.velocity, 0.0)
        shown = self._shown()
        return shown.set("reward", self.compute_reward(shown["achieved_goal"], shown["desired_goal"]))

    def _shown(self) -> TensorDict:
        off = torch.zeros(*self.batch_size, 1, dtype=torch.bool)
        return TensorDict(
            {
                "observation": torch.cat((self.place, self.velocity), -1),
                "achieved_goal": self.place.clone(),
                "desired_goal": self.goal.clone(),
                "done": off,
                "terminated": off.clone(),
            },
            self.batch_size,
        )
