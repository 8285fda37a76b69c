"""The training loop: learners, evaluation metrics, checkpoints."""

from torchrl_her.trainers.adam import RunsAdam
from torchrl_her.trainers.checkpoint import (
    CheckpointError,
    buffer_state_dict,
    collector_state_dict,
    load_buffer_state_dict,
    load_checkpoint,
    load_collector_state_dict,
    load_newest_checkpoint,
    save_checkpoint,
)
from torchrl_her.trainers.cut import cut_episodes
from torchrl_her.trainers.fused import FusedLearner
from torchrl_her.trainers.fusing import is_plain_adam, why_not_fused
from torchrl_her.trainers.graphs import GraphLearner, why_not_recorded
from torchrl_her.trainers.learner import Learner, LossLearner
from torchrl_her.trainers.metrics import (
    discounted_return,
    final_distance,
    first_episode,
    q_bias,
    reached,
    success,
)
from torchrl_her.trainers.runs import clip_by_run, keep_runs
from torchrl_her.trainers.trainer import CollectsAhead, Replay, Schedule, Trainer, evaluate

__all__ = [
    "CheckpointError",
    "CollectsAhead",
    "FusedLearner",
    "GraphLearner",
    "Learner",
    "LossLearner",
    "Replay",
    "RunsAdam",
    "Schedule",
    "Trainer",
    "buffer_state_dict",
    "clip_by_run",
    "collector_state_dict",
    "cut_episodes",
    "discounted_return",
    "evaluate",
    "final_distance",
    "first_episode",
    "is_plain_adam",
    "keep_runs",
    "load_buffer_state_dict",
    "load_checkpoint",
    "load_collector_state_dict",
    "load_newest_checkpoint",
    "q_bias",
    "reached",
    "save_checkpoint",
    "success",
    "why_not_fused",
    "why_not_recorded",
]
