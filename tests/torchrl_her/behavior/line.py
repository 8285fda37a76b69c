"""Environments on a line: an agent walks right, a step of one each time, and 9 is wanted."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

WANTED = 9.0


class Line(EnvBase):
    """N walks from 0; an episode is truncated after ``steps`` steps, and ends at 9 or beyond ``edge``."""

    def __init__(
        self, num_envs: int = 2, *, steps: int = 5, edge: float = 1e9, device: torch.device | str = "cpu"
    ) -> None:
        super().__init__(batch_size=[num_envs], device=device)
        self.steps, self.edge = steps, edge
        self.place = torch.zeros(num_envs, 1, device=device)
        self.time = torch.zeros(num_envs, 1, device=device)
        one = Unbounded((num_envs, 1), device=device)
        self.observation_spec = Composite(
            {key: one.clone() for key in ("observation", "achieved_goal", "desired_goal")},
            shape=[num_envs],
        )
        self.action_spec = Bounded(-1.0, 1.0, (num_envs, 1), device=device)
        self.reward_spec = Unbounded((num_envs, 1), device=device)
        flags = Binary(shape=(num_envs, 1), dtype=torch.bool, device=device)
        self.done_spec = Composite(
            {key: flags.clone() for key in ("done", "terminated", "truncated")}, shape=[num_envs]
        )

    def _shown(self) -> dict[str, torch.Tensor]:
        return {
            "observation": 10.0 * self.place,
            "achieved_goal": self.place.clone(),
            "desired_goal": torch.full_like(self.place, WANTED),
        }

    def _reset(self, tensordict: TensorDictBase | None, **kwargs: object) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        begins = torch.ones_like(self.place, dtype=torch.bool) if mask is None else mask.view_as(self.place)
        self.place = torch.where(begins, 0.0, self.place)
        self.time = torch.where(begins, 0.0, self.time)
        return TensorDict(self._shown(), self.batch_size, device=self.device)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.place = self.place + tensordict["action"]
        self.time = self.time + 1
        achieved = (self.place - WANTED).abs() < 0.5
        terminated, truncated = achieved | (self.place > self.edge), self.time >= self.steps
        ends = {"terminated": terminated, "truncated": truncated, "done": terminated | truncated}
        after = {**self._shown(), "reward": achieved.float() - 1.0, **ends}
        return TensorDict(after, self.batch_size, device=self.device)

    def _set_seed(self, seed: int | None) -> None:
        """Nothing is random."""


# A step to the right.
walk = TensorDictModule(torch.ones_like, in_keys=["observation"], out_keys=["action"])
