"""TorchRL environments as users write them: a point with a goal, alone or as a batch."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

NOT_CALLABLE = 3


class Point(EnvBase):
    """A point in a square; an episode ends at its goal.

    Args:
        size: of the batch, none if 0.
        dense: whether the reward is the distance.
        goes_on: whether goals do not end an episode.
    """

    max_steps = 8

    def __init__(self, size: int = 0, *, dense: bool = False, goes_on: bool = False) -> None:
        super().__init__(batch_size=[size] if size else [])
        self.dense, self.goes_on_there = dense, goes_on
        batch = self.batch_size
        seen = {key: Unbounded(shape=(*batch, 2)) for key in ("observation", "achieved_goal", "desired_goal")}
        self.observation_spec = Composite(seen, shape=batch)
        self.action_spec = Bounded(-1.0, 1.0, (*batch, 2))
        self.reward_spec = Unbounded(shape=(*batch, 1))
        self.rng = torch.Generator()

    def _set_seed(self, seed: int | None) -> None:
        self.rng.manual_seed(seed or 0)
        torch.manual_seed(123)  # as many do; the run's own numbers must not notice

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        fresh = [torch.rand(*self.batch_size, 2, generator=self.rng) * 2 - 1 for _ in range(2)]
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is not None:
            fresh = [
                torch.where(mask, new, old) for new, old in zip(fresh, (self.at, self.goal), strict=True)
            ]
        self.at, self.goal = fresh
        return TensorDict(self._shown(), self.batch_size)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.at = (self.at + 0.5 * tensordict["action"]).clamp(-1, 1)
        reward = self.compute_reward(self.at, self.goal)
        met = (self.at - self.goal).norm(dim=-1, keepdim=True) < 0.5
        ends = met & (not self.goes_on_there)
        return TensorDict(
            {**self._shown(), "reward": reward, "done": ends, "terminated": ends}, self.batch_size
        )

    def _shown(self) -> dict[str, Tensor]:
        return {"observation": self.at, "achieved_goal": self.at.clone(), "desired_goal": self.goal}

    def compute_reward(self, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
        gap = (achieved_goal - desired_goal).norm(dim=-1, keepdim=True)
        return -gap if self.dense else -(gap >= 0.5).float()

    def render(self) -> Tensor:
        place = ((self.at + 1) * 100).to(torch.uint8)
        return place[..., None, None, :1].expand(*self.batch_size, 4, 6, 3)


def make_points(num_envs: int, *, dense: bool = False) -> Point:
    return Point(num_envs, dense=dense)


def make_number() -> int:
    return 3


class Bare(Point):
    compute_reward = None  # type: ignore[assignment]

    def __init__(self) -> None:
        super().__init__()


class Endless(Point):
    max_steps = None  # type: ignore[assignment]


class Levers(Point):
    """A point that is moved by actions in units of their own; those beyond the bounds are an error."""

    def __init__(self, size: int) -> None:
        super().__init__(size)
        low, high = torch.tensor([0.0, -30.0]), torch.tensor([10.0, 50.0])
        self.action_spec = Bounded(low.expand(size, 2), high.expand(size, 2))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        assert self.action_spec.is_in(tensordict["action"])
        low, high = self.action_spec.space.low, self.action_spec.space.high
        return super()._step(tensordict.replace(action=(tensordict["action"] - low) / (high - low) * 2 - 1))


def make_levers(num_envs: int) -> Levers:
    return Levers(num_envs)


class Wide(Point):
    def compute_reward(self, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
        return super().compute_reward(achieved_goal, desired_goal).squeeze(-1)


class Buttons(Point):
    """A point that is moved by a matrix [1, 2] of whole numbers from 0 to 4, or by one that never changes."""

    def __init__(self, fixed: bool = False) -> None:
        super().__init__()
        low = torch.tensor([[0, 2 if fixed else 0]])
        self.action_spec = Bounded(low, torch.tensor([[4, 2 if fixed else 4]]), (1, 2), dtype=torch.int64)
        self.pressed: list[list[int]] = []

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict["action"]
        assert action.shape == (1, 2)
        assert action.dtype == torch.int64
        self.pressed += action.tolist()
        return super()._step(tensordict.replace(action=(action[0] - 2) / 2))


class Near(Point):
    """A point whose reward looks at where it is now, besides the goals."""

    def compute_reward(self, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
        near = (achieved_goal - self.at).norm(dim=-1, keepdim=True) < 0.5
        return super().compute_reward(achieved_goal, desired_goal) - near.float()


class Costly(Point):
    """A point whose steps cost a quarter of their length, which they show."""

    def __init__(self, size: int = 0) -> None:
        super().__init__(size)
        self.observation_spec["cost"] = Unbounded(shape=(*self.batch_size, 1))
        self.cost = torch.zeros(*self.batch_size, 1)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.cost = tensordict["action"].norm(dim=-1, keepdim=True) / 4
        return super()._step(tensordict)

    def _shown(self) -> dict[str, Tensor]:
        return {**super()._shown(), "cost": self.cost}

    def compute_reward(
        self, achieved_goal: Tensor, desired_goal: Tensor, info: dict[str, Tensor] | None = None
    ) -> Tensor:
        cost = self.cost if info is None else info["cost"]
        return super().compute_reward(achieved_goal, desired_goal) - cost


def make_costly(num_envs: int) -> Costly:
    return Costly(num_envs)


class Crane(Point):
    """A point whose goals are its coordinates, each an entry of its own, x behind y."""

    def __init__(self, size: int = 0) -> None:
        super().__init__(size)
        names = ("sensors", "y", "x", "y_to", "x_to")
        widths = {name: 2 if name == "sensors" else 1 for name in names}
        batch = self.batch_size
        seen = {name: Unbounded(shape=(*batch, width)) for name, width in widths.items()}
        self.observation_spec = Composite(seen, shape=batch)

    def _shown(self) -> dict[str, Tensor]:
        (x, y), (x_to, y_to) = self.at.split(1, -1), self.goal.split(1, -1)
        return {"sensors": self.at, "x": x.clone(), "y": y.clone(), "x_to": x_to, "y_to": y_to}

    def compute_reward(self, achieved_goal: Any, desired_goal: Any) -> Tensor:
        if isinstance(achieved_goal, dict):
            achieved_goal = torch.cat([achieved_goal[key] for key in ("x", "y")], -1)
            desired_goal = torch.cat([desired_goal[key] for key in ("x_to", "y_to")], -1)
        return super().compute_reward(achieved_goal, desired_goal)


def make_crane(num_envs: int) -> Crane:
    return Crane(num_envs)


class Lost(Point):
    """A point whose second coordinate cannot be seen at the right."""

    def _shown(self) -> dict[str, Tensor]:
        seen = super()._shown()
        at = seen["observation"]
        return {**seen, "observation": torch.where(at[..., :1] > 0, at / torch.tensor([1.0, 0.0]), at)}
