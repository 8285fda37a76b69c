"""A gymnasium environment whose rewards read info, in the forms that such functions take."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

COSTLY = "tests/InfoCost-v0"  # episodes of 6 steps


class Costly(gymnasium.Env):
    """A point on a line from 0 to 4, moved by up to 1; a step costs a quarter of its length, as info says.

    Args:
        form: how ``compute_reward`` takes infos: of one pair of goals (``"one"``), as dictionary of arrays
            (``"arrays"``), as array of dictionaries (``"infos"``), or of one pair, and maybe none
            (``"maybe"``).
        cost: what info has in place of the cost.
        lacks_from: step from which on info lacks the cost, counted over all episodes.
    """

    def __init__(self, form: str = "one", cost: Any = None, lacks_from: int = 1_000) -> None:
        row = spaces.Box(-10.0, 10.0, (1,), np.float64)
        self.observation_space = spaces.Dict(observation=row, achieved_goal=row, desired_goal=row)
        self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float64)
        self.form, self.cost, self.lacks_from, self.steps = form, cost, lacks_from, 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]:
        super().reset(seed=seed)
        self.at, self.goal = self.np_random.uniform(0.0, 4.0, (2, 1))
        return self._show(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.at = np.clip(self.at + action, 0.0, 4.0)
        cost = float(np.abs(action).sum()) / 4
        self.steps += 1
        info = {"cost": cost if self.cost is None else self.cost} if self.steps < self.lacks_from else {}
        reward = -float(np.abs(self.at - self.goal)[0] > 0.5) - cost
        return self._show(), reward, False, False, info

    def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, info: Any) -> Any:
        far = np.abs(achieved - desired)[..., 0] > 0.5
        if self.form == "infos" and achieved.ndim > 1:
            return -far.astype(np.float64) - np.array([own["cost"] for own in info])
        cost = info.get("cost", 0.0) if self.form == "maybe" else info["cost"]
        if self.form == "one" and achieved.ndim > 1:
            raise ValueError("one pair of goals")
        return -far.astype(np.float64) - cost

    def _show(self) -> dict[str, np.ndarray]:
        return {"observation": self.at, "achieved_goal": self.at, "desired_goal": self.goal}


gymnasium.register(COSTLY, Costly, max_episode_steps=6)
