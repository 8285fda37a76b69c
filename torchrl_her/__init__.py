"""Hindsight experience replay as TorchRL replay-buffer parts."""

from torchrl_her.checkpoint import (
    CheckpointError,
    buffer_state_dict,
    load_buffer_state_dict,
    load_checkpoint,
    save_checkpoint,
)
from torchrl_her.episodes import Episodes, find_episodes
from torchrl_her.exploration import DecayingEpsilon, explore
from torchrl_her.fused import FusedDDPGLearner, can_fuse
from torchrl_her.goals import EnvReward, GoalReward, RewardFunction, achieved, distance
from torchrl_her.losses import (
    ClampedTD0,
    Learner,
    LossLearner,
    PenalisedDDPGLoss,
    clip_by_run,
    make_ddpg_loss,
    make_target_updater,
)
from torchrl_her.metrics import discounted_return, final_distance, first_episode, q_bias, success
from torchrl_her.networks import ActorNet, CriticNet, make_actor, make_critic, stack_runs, take_run
from torchrl_her.training import Trainer, evaluate
from torchrl_her.virtual_goals import Strategy, candidates, combine, draw, draw_alike, window
from torchrl_her.writer import GoalWeights, HERWriter, WriterCounts

__all__ = [
    "ActorNet",
    "CheckpointError",
    "ClampedTD0",
    "CriticNet",
    "DecayingEpsilon",
    "EnvReward",
    "Episodes",
    "FusedDDPGLearner",
    "GoalReward",
    "GoalWeights",
    "HERWriter",
    "Learner",
    "LossLearner",
    "PenalisedDDPGLoss",
    "RewardFunction",
    "Strategy",
    "Trainer",
    "WriterCounts",
    "achieved",
    "buffer_state_dict",
    "can_fuse",
    "candidates",
    "clip_by_run",
    "combine",
    "discounted_return",
    "distance",
    "draw",
    "draw_alike",
    "evaluate",
    "explore",
    "final_distance",
    "find_episodes",
    "first_episode",
    "load_buffer_state_dict",
    "load_checkpoint",
    "make_actor",
    "make_critic",
    "make_ddpg_loss",
    "make_target_updater",
    "q_bias",
    "save_checkpoint",
    "stack_runs",
    "success",
    "take_run",
    "window",
]
