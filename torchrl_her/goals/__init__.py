"""Goals: their rewards, the strategies that choose virtual goals, and weights for how useful each goal is."""

from torchrl_her.goals.density import log_kernel_density, log_neighbor_density
from torchrl_her.goals.factors import candidates, combine, draw, draw_uniformly, draw_weighted
from torchrl_her.goals.grid import GoalGrid, box_target, kl_divergence, sampled_target
from torchrl_her.goals.ibs import GoalHistogram, Instructiveness
from torchrl_her.goals.instructive import InstructiveWeights
from torchrl_her.goals.kernel_ibs import KernelInstructiveness
from torchrl_her.goals.rare import RareGoals
from torchrl_her.goals.rewards import (
    EnvReward,
    GoalReward,
    RewardFunction,
    achieved,
    distance,
    ends_at_goals,
    is_achieved,
)
from torchrl_her.goals.rnd import NetworkNovelty
from torchrl_her.goals.strategies import (
    STRATEGIES,
    Strategy,
    StrategyFunction,
    candidate_range,
    get_strategy,
    register_strategy,
    strategy_name,
)
from torchrl_her.goals.weights import GoalWeights, WeightsOfRuns

__all__ = [
    "STRATEGIES",
    "EnvReward",
    "GoalGrid",
    "GoalHistogram",
    "GoalReward",
    "GoalWeights",
    "InstructiveWeights",
    "Instructiveness",
    "KernelInstructiveness",
    "NetworkNovelty",
    "RareGoals",
    "RewardFunction",
    "Strategy",
    "StrategyFunction",
    "WeightsOfRuns",
    "achieved",
    "box_target",
    "candidate_range",
    "candidates",
    "combine",
    "distance",
    "draw",
    "draw_uniformly",
    "draw_weighted",
    "ends_at_goals",
    "get_strategy",
    "is_achieved",
    "kl_divergence",
    "log_kernel_density",
    "log_neighbor_density",
    "register_strategy",
    "sampled_target",
    "strategy_name",
]
