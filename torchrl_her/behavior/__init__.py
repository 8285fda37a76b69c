"""Behavior goals: which goals the next episodes ask for, proposed from those that were achieved."""

from torchrl_her.behavior.factors import (
    DiscoverScore,
    GoalCandidates,
    GoalFactor,
    InverseDensity,
    Successes,
    ValueCutoff,
)
from torchrl_her.behavior.memory import AchievedGoals
from torchrl_her.behavior.transform import BehaviorGoals
from torchrl_her.behavior.values import GoalValues

__all__ = [
    "AchievedGoals",
    "BehaviorGoals",
    "DiscoverScore",
    "GoalCandidates",
    "GoalFactor",
    "GoalValues",
    "InverseDensity",
    "Successes",
    "ValueCutoff",
]
