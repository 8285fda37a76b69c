"""Throwing and reaching tasks with goals, batched, for TorchRL."""

from torchrl_her_envs.goals import BoxGoals, GoalDistribution, SectorGoals
from torchrl_her_envs.hand import Hand
from torchrl_her_envs.physics import BallPhysics
from torchrl_her_envs.registry import get_task, make_env
from torchrl_her_envs.robot import Arm
from torchrl_her_envs.task import TASKS, Task, WorldConfig
from torchrl_her_envs.throwing import ThrowingEnv, WorldState

__all__ = [
    "TASKS",
    "Arm",
    "BallPhysics",
    "BoxGoals",
    "GoalDistribution",
    "Hand",
    "SectorGoals",
    "Task",
    "ThrowingEnv",
    "WorldConfig",
    "WorldState",
    "get_task",
    "make_env",
]
