"""Hindsight experience replay as TorchRL replay-buffer parts."""

from torchrl_her.checkpoint import (
    CheckpointError,
    buffer_state_dict,
    collector_state_dict,
    load_buffer_state_dict,
    load_checkpoint,
    load_collector_state_dict,
    load_newest_checkpoint,
    save_checkpoint,
)
from torchrl_her.compiling import CompiledOnce
from torchrl_her.curriculum import Curriculum, CurriculumLayer, CurriculumProgress, zero_unused_inputs
from torchrl_her.curriculum_transforms import StateToObs, ZeroPad
from torchrl_her.dqn import QNet, make_dqn_loss, make_q_actor
from torchrl_her.episodes import Episodes, find_episodes
from torchrl_her.exploration import (
    DecayingEpsilon,
    DecayingEpsilonGreedy,
    Exploration,
    explore,
    explore_actions,
)
from torchrl_her.fused import FusedDDPGLearner, can_fuse, is_plain_adam
from torchrl_her.goal_drawing import draw_goals
from torchrl_her.goal_grid import GoalGrid, box_target, kl_divergence, sampled_target
from torchrl_her.goal_weights import GoalWeights
from torchrl_her.goals import EnvReward, GoalReward, RewardFunction, achieved, distance
from torchrl_her.instructiveness import GoalHistogram, Instructiveness
from torchrl_her.layer_change import enter_layer, set_layer_goals
from torchrl_her.losses import (
    ClampedTD0,
    Learner,
    LossLearner,
    PenalisedDDPGLoss,
    clamped_td0,
    clip_by_run,
    keep_runs,
    make_ddpg_loss,
    make_target_updater,
)
from torchrl_her.metrics import discounted_return, final_distance, first_episode, q_bias, success
from torchrl_her.networks import (
    ActorNet,
    CriticNet,
    StackedLinear,
    make_actor,
    make_critic,
    stack_runs,
    take_run,
)
from torchrl_her.sac import StochasticActorNet, make_sac_loss, make_stochastic_actor
from torchrl_her.sampler import HERSampleUnit
from torchrl_her.td3 import make_td3_loss
from torchrl_her.training import Schedule, Trainer, evaluate
from torchrl_her.virtual_goals import Strategy, candidates, combine, draw, draw_alike, draw_weighted, window
from torchrl_her.writer import HERWriter, WriterCounts

__all__ = [
    "ActorNet",
    "CheckpointError",
    "ClampedTD0",
    "CompiledOnce",
    "CriticNet",
    "Curriculum",
    "CurriculumLayer",
    "CurriculumProgress",
    "DecayingEpsilon",
    "DecayingEpsilonGreedy",
    "EnvReward",
    "Episodes",
    "Exploration",
    "FusedDDPGLearner",
    "GoalGrid",
    "GoalHistogram",
    "GoalReward",
    "GoalWeights",
    "HERSampleUnit",
    "HERWriter",
    "Instructiveness",
    "Learner",
    "LossLearner",
    "PenalisedDDPGLoss",
    "QNet",
    "RewardFunction",
    "Schedule",
    "StackedLinear",
    "StateToObs",
    "StochasticActorNet",
    "Strategy",
    "Trainer",
    "WriterCounts",
    "ZeroPad",
    "achieved",
    "box_target",
    "buffer_state_dict",
    "can_fuse",
    "candidates",
    "clamped_td0",
    "clip_by_run",
    "collector_state_dict",
    "combine",
    "discounted_return",
    "distance",
    "draw",
    "draw_alike",
    "draw_goals",
    "draw_weighted",
    "enter_layer",
    "evaluate",
    "explore",
    "explore_actions",
    "final_distance",
    "find_episodes",
    "first_episode",
    "is_plain_adam",
    "keep_runs",
    "kl_divergence",
    "load_buffer_state_dict",
    "load_checkpoint",
    "load_collector_state_dict",
    "load_newest_checkpoint",
    "make_actor",
    "make_critic",
    "make_ddpg_loss",
    "make_dqn_loss",
    "make_q_actor",
    "make_sac_loss",
    "make_stochastic_actor",
    "make_target_updater",
    "make_td3_loss",
    "q_bias",
    "sampled_target",
    "save_checkpoint",
    "set_layer_goals",
    "stack_runs",
    "success",
    "take_run",
    "window",
    "zero_unused_inputs",
]
