"""Hindsight experience replay as TorchRL replay-buffer parts."""

from torchrl_her.checkpoint import (
    CheckpointError,
    buffer_state_dict,
    load_buffer_state_dict,
    load_checkpoint,
    save_checkpoint,
)
from torchrl_her.compiling import CompiledOnce
from torchrl_her.curriculum import Curriculum, CurriculumLayer, CurriculumProgress, zero_unused_inputs
from torchrl_her.curriculum_transforms import StateToObs, ZeroPad
from torchrl_her.episodes import Episodes, find_episodes
from torchrl_her.exploration import DecayingEpsilon, explore
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
from torchrl_her.sampler import HERSampleUnit
from torchrl_her.training import Trainer, evaluate
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
    "EnvReward",
    "Episodes",
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
    "RewardFunction",
    "StackedLinear",
    "StateToObs",
    "Strategy",
    "Trainer",
    "WriterCounts",
    "ZeroPad",
    "achieved",
    "box_target",
    "buffer_state_dict",
    "can_fuse",
    "candidates",
    "clip_by_run",
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
    "final_distance",
    "find_episodes",
    "first_episode",
    "is_plain_adam",
    "keep_runs",
    "kl_divergence",
    "load_buffer_state_dict",
    "load_checkpoint",
    "make_actor",
    "make_critic",
    "make_ddpg_loss",
    "make_target_updater",
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
