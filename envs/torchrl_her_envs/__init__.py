"""Throwing and reaching tasks with goals, batched, for TorchRL."""

from torchrl_her_envs.canvas import to_pixel
from torchrl_her_envs.controllers import Controller, make_controller
from torchrl_her_envs.goals import BoxGoals, GoalDistribution, SectorGoals
from torchrl_her_envs.hand import Hand
from torchrl_her_envs.physics import BallPhysics
from torchrl_her_envs.recording import base_env, record_episodes
from torchrl_her_envs.registry import get_task, make_env
from torchrl_her_envs.rendering import render
from torchrl_her_envs.robot import Arm
from torchrl_her_envs.small_worlds import BitFlip, Chain, LatticeGoals, TreasureHunt
from torchrl_her_envs.task import TASKS, Task, WorldConfig
from torchrl_her_envs.throwing import ThrowingEnv, WorldState
from torchrl_her_envs.video import write_video

__all__ = [
    "TASKS",
    "Arm",
    "BallPhysics",
    "BitFlip",
    "BoxGoals",
    "Chain",
    "Controller",
    "GoalDistribution",
    "Hand",
    "LatticeGoals",
    "SectorGoals",
    "Task",
    "ThrowingEnv",
    "TreasureHunt",
    "WorldConfig",
    "WorldState",
    "base_env",
    "get_task",
    "make_controller",
    "make_env",
    "record_episodes",
    "render",
    "to_pixel",
    "write_video",
]
