"""A small gymnasium environment with goals, in all the forms that such environments take."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

import torchrl_her_envs  # loads TorchRL when it is first used, and so not in the processes of environments

WALK = "tests/Walk-v0"  # episodes of 6 steps
LAST = 4  # places 0 to 4
ROW = spaces.Box(-10.0, 10.0, (1,), np.float64)


class Walk(gymnasium.Env):
    """A walk on a line, one place left (action 0) or right (1) a step, to another place.

    Args:
        ends: whether an episode ends at the goal.
        form: how the functions take goals: ``"batch"``, or ``"single"``, which sum over all that they get.
        without: a key or method that it lacks.
        actions: the space of actions, whose first entry says where to.
        shown: spaces instead of its own.
    """

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012

    def __init__(
        self,
        *,
        ends: bool = True,
        form: str = "batch",
        without: str = "",
        actions: spaces.Space | None = None,
        shown: dict[str, spaces.Space] | spaces.Box | None = None,
        render_mode: str | None = None,
    ) -> None:
        keys = ("observation", "achieved_goal", "desired_goal")
        own = {key: ROW for key in keys if key != without}
        whole = isinstance(shown, spaces.Box)
        self.observation_space = shown if whole else spaces.Dict(own | (shown or {}))
        self.action_space = actions or spaces.Discrete(2)
        self.ends, self.form, self.without, self.render_mode = ends, form, without, render_mode
        self.asked: list[tuple[int, ...]] = []  # shapes of goals

    def __getattribute__(self, name: str) -> Any:
        if name.startswith("compute_") and name == self.without:
            raise AttributeError(name)
        return super().__getattribute__(name)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]:
        super().reset(seed=seed)
        self.place, self.goal = (float(x) for x in self.np_random.choice(LAST + 1, 2, replace=False))
        return self._show(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        assert self.action_space.contains(np.asarray(action))
        right = np.ravel(action)[0] > getattr(self.action_space, "start", 0)
        self.place = float(np.clip(self.place + (1 if right else -1), 0, LAST))
        goals = np.array([self.place]), np.array([self.goal])
        reward = float(self.compute_reward(*goals, {}))
        return self._show(), reward, bool(self.compute_terminated(*goals, {})), False, {}

    def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, info: Any) -> Any:
        self.asked.append(achieved.shape)
        axis = -1 if self.form == "batch" else None
        gap = np.abs(achieved - desired).sum(axis)
        far = np.maximum(achieved - desired, 0).sum(axis) > 2  # not the same from the other side
        return -(gap > 0).astype(np.float64) - far

    def compute_terminated(self, achieved: np.ndarray, desired: np.ndarray, info: Any) -> Any:
        if not self.ends:
            return False
        return self.compute_reward(achieved, desired, info) == 0

    def render(self) -> np.ndarray:
        return np.full((4, 6, 3), int(self.place), np.uint8)

    def _show(self) -> dict[str, np.ndarray]:
        places = {"observation": self.place, "achieved_goal": self.place, "desired_goal": self.goal}
        return {key: np.ravel(place) for key, place in places.items()}


class Plain(Walk):
    """A walk with nothing but compute_reward.

    Args:
        stops: whether a step at the goal terminates the episode.
        tells: whether info has is_success.
        unseen: whether goals are so far away that no random walk gets there.
        keeps: whether the goal is an array, which can be set to another.
        falls: whether the episode terminates in place 0.
        dense: whether the reward is the distance.
        cost: of each step, which compute_reward does not know.
    """

    def __init__(
        self,
        *,
        stops: bool = True,
        tells: bool = True,
        unseen: bool = False,
        keeps: bool = False,
        falls: bool = False,
        dense: bool = False,
        cost: float = 0.0,
        form: str = "batch",
        render_mode: str | None = None,
    ) -> None:
        super().__init__(without="compute_terminated", form=form, render_mode=render_mode)
        self.stops, self.tells, self.falls, self.dense, self.unseen = stops, tells, falls, dense, unseen
        self.cost, self.keeps = cost, keeps

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        if self.unseen:
            self.goal = np.array([9.0]) if self.keeps else 9.0
        if self.falls:
            self.place, self.goal = 2.0, 4.0
        return self._show(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.place = float(np.clip(self.place + (1 if np.ravel(action)[0] > 0 else -1), 0, 4))
        met = bool(self.place == self.goal)
        reward = self.compute_reward(np.array([self.place]), np.ravel(self.goal), {})
        ends = (self.stops and met) or (self.falls and self.place == 0)
        return self._show(), float(reward) - self.cost, ends, False, {"is_success": met} if self.tells else {}

    def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, info: Any) -> Any:
        if self.dense:
            return -np.abs(achieved - desired).sum(-1)
        return super().compute_reward(achieved, desired, info)


gymnasium.register(WALK, Walk, max_episode_steps=6)
gymnasium.register("tests/Plain-v0", Plain, max_episode_steps=6)
gymnasium.register("tests/Endless-v0", Walk)


def walk(num_envs: int = 1, **options: Any) -> torchrl_her_envs.GymGoalEnv:
    return torchrl_her_envs.make_gym_env(WALK, num_envs=num_envs, **options)
