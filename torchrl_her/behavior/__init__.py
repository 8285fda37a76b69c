"""Behavior goals: which goals the next episodes ask for, proposed from those that were achieved."""

from torchrl_her.behavior.factors import Achievable, Directed, GoalFactor, Offers, Rare, Successes
from torchrl_her.behavior.memory import AchievedGoals
from torchrl_her.behavior.transform import BehaviorGoals
from torchrl_her.behavior.values import GoalValues

__all__ = [
    "Achievable",
    "AchievedGoals",
    "BehaviorGoals",
    "Directed",
    "GoalFactor",
    "GoalValues",
    "Offers",
    "Rare",
    "Successes",
]
