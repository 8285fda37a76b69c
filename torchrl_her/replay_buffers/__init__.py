"""Hindsight relabeling in replay buffers, as transitions are written or as they are sampled."""

from torchrl_her.replay_buffers.draw import draw_goals
from torchrl_her.replay_buffers.env_ids import EnvIds
from torchrl_her.replay_buffers.episode_index import EpisodeIndex, index_episodes
from torchrl_her.replay_buffers.episodes import Episodes, find_episodes
from torchrl_her.replay_buffers.keys import TransitionKeys
from torchrl_her.replay_buffers.options import HindsightBase, HindsightOptions
from torchrl_her.replay_buffers.runs.buffer import empty_run, rows_of_run, runs_of, sizes_of
from torchrl_her.replay_buffers.runs.counts import WriterCounts
from torchrl_her.replay_buffers.runs.sampler import RunsPrioritizedSampler, RunsSampler
from torchrl_her.replay_buffers.runs.storage import PackedStorage
from torchrl_her.replay_buffers.sample_unit import HERSampleUnit
from torchrl_her.replay_buffers.stage_rules import StageRule
from torchrl_her.replay_buffers.symmetry import AugmentBatch, Shift, Symmetry
from torchrl_her.replay_buffers.writer import HERWriter

__all__ = [
    "AugmentBatch",
    "EnvIds",
    "EpisodeIndex",
    "Episodes",
    "HERSampleUnit",
    "HERWriter",
    "HindsightBase",
    "HindsightOptions",
    "PackedStorage",
    "RunsPrioritizedSampler",
    "RunsSampler",
    "Shift",
    "StageRule",
    "Symmetry",
    "TransitionKeys",
    "WriterCounts",
    "draw_goals",
    "empty_run",
    "find_episodes",
    "index_episodes",
    "rows_of_run",
    "runs_of",
    "sizes_of",
]
