"""The ids of our tasks, and short ways to make them."""

from __future__ import annotations

from typing import Any

import gymnasium
from gymnasium.vector import VectorEnv

IDS = {
    "hand_reach": "torchrl_her/HandReach-v0",
    "hand_v0": "torchrl_her/HandThrow-v0",
    "hand_v1": "torchrl_her/HandThrow-v1",
    "hand_v2": "torchrl_her/HandThrow-v2",
    "hand_wall_v0": "torchrl_her/HandWallThrow-v0",
    "hand_wall_v1": "torchrl_her/HandWallThrow-v1",
    "hand_wall_v2": "torchrl_her/HandWallThrow-v2",
    "robot_reach": "torchrl_her/RobotReach-v0",
    "robot_v0": "torchrl_her/RobotThrow-v0",
    "robot_v1": "torchrl_her/RobotThrow-v1",
    "robot_v2": "torchrl_her/RobotThrow-v2",
}


def make(task: str = "hand_v2", **options: Any) -> gymnasium.Env:
    return gymnasium.make(IDS[task], **options)


def make_many(task: str = "hand_v2", num_envs: int = 4, **options: Any) -> VectorEnv:
    return gymnasium.make_vec(IDS[task], num_envs=num_envs, **options)
