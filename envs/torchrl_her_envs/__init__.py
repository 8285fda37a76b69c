"""Throwing and reaching tasks with goals, batched, for TorchRL."""

from torchrl_her_envs.canvas import to_pixel
from torchrl_her_envs.controllers import Controller, make_controller
from torchrl_her_envs.effector import Effector
from torchrl_her_envs.goal_env import GoalEnv, goal_env, reward_range
from torchrl_her_envs.goals import BoxGoals, GoalDistribution, SectorGoals
from torchrl_her_envs.gym_in import GymGoalEnv, make_gym_env
from torchrl_her_envs.gym_registry import gym_id, register_tasks
from torchrl_her_envs.hand import Hand
from torchrl_her_envs.physics import BallPhysics
from torchrl_her_envs.recording import base_env, record_episodes
from torchrl_her_envs.registry import SMALL_WORLDS, get_task, make_env
from torchrl_her_envs.rendering import render
from torchrl_her_envs.robot import Arm
from torchrl_her_envs.seeded_worlds import SeededWorlds
from torchrl_her_envs.small_worlds import BitFlip, Chain, LatticeGoals, SmallWorld, TreasureHunt
from torchrl_her_envs.task import TASKS, Task, WorldConfig
from torchrl_her_envs.throwing import ThrowingEnv, WorldState
from torchrl_her_envs.video import write_video

__all__ = [
    "SMALL_WORLDS",
    "TASKS",
    "Arm",
    "BallPhysics",
    "BitFlip",
    "BoxGoals",
    "Chain",
    "Controller",
    "Effector",
    "GoalDistribution",
    "GoalEnv",
    "GymGoalEnv",
    "Hand",
    "LatticeGoals",
    "SectorGoals",
    "SeededWorlds",
    "SmallWorld",
    "Task",
    "ThrowingEnv",
    "TreasureHunt",
    "WorldConfig",
    "WorldState",
    "base_env",
    "get_task",
    "goal_env",
    "gym_id",
    "make_controller",
    "make_env",
    "make_gym_env",
    "record_episodes",
    "register_tasks",
    "render",
    "reward_range",
    "to_pixel",
    "write_video",
]

register_tasks()
