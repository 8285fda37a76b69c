"""A gymnasium environment in a module of its own, as somebody who shares a run has it."""

from __future__ import annotations

from pathlib import Path

SOURCE = """
import gymnasium
import numpy as np
from gymnasium import spaces

ROW = spaces.Box(-2.0, 2.0, (2,), np.float64)


class Maze(gymnasium.Env):
    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(self, render_mode=None):
        self.render_mode = render_mode
        self.observation_space = spaces.Dict(observation=ROW, achieved_goal=ROW, desired_goal=ROW)
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.at, self.goal = self.np_random.uniform(-1, 1, (2, 2))
        return self._show(), {}

    def step(self, action):
        self.at = np.clip(self.at + 0.5 * action, -2, 2)
        reward = float(self.compute_reward(self.at, self.goal, {}))
        return self._show(), reward, reward == 10.0, False, {"is_success": reward == 10.0}

    def compute_reward(self, achieved, desired, info):
        return 10.0 * (np.linalg.norm(achieved - desired, axis=-1) < 0.4)

    def render(self):
        return np.full((40, 40, 3), 90, np.uint8)

    def _show(self):
        return {"observation": self.at, "achieved_goal": self.at, "desired_goal": self.goal}


gymnasium.register("Maze-v0", Maze, max_episode_steps=10)
"""


def write_module(folder: Path, name: str) -> str:
    """Writes the module into a folder; returns the task of its environment."""
    (folder / f"{name}.py").write_text(SOURCE)
    return f"gym:{name}:Maze-v0"
