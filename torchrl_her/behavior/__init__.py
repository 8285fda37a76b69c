"""Behavior goals: proposes goals that were achieved before as the goals of some of the next episodes."""

from torchrl_her.behavior.factors import (
    DiscoverScore,
    GoalCandidates,
    GoalFactor,
    InverseDensity,
    Successes,
    ValueCutoff,
)
from torchrl_her.behavior.memory import AchievedGoals
from torchrl_her.behavior.proposal import GoalProposal
from torchrl_her.behavior.transform import BehaviorGoals
from torchrl_her.behavior.values import GoalValues

__all__ = [
    "AchievedGoals",
    "BehaviorGoals",
    "DiscoverScore",
    "GoalCandidates",
    "GoalFactor",
    "GoalProposal",
    "GoalValues",
    "InverseDensity",
    "Successes",
    "ValueCutoff",
]
