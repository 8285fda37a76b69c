"""Hindsight in a replay buffer: as transitions are written, or as they are sampled."""

from torchrl_her.replay_buffers.draw import draw_goals
from torchrl_her.replay_buffers.env_ids import EnvIds
from torchrl_her.replay_buffers.episode_index import EpisodeIndex, index_episodes
from torchrl_her.replay_buffers.episodes import Episodes, find_episodes
from torchrl_her.replay_buffers.keys import TransitionKeys
from torchrl_her.replay_buffers.options import HindsightBase, HindsightOptions
from torchrl_her.replay_buffers.sample_unit import HERSampleUnit
from torchrl_her.replay_buffers.writer import HERWriter, WriterCounts

__all__ = [
    "EnvIds",
    "EpisodeIndex",
    "Episodes",
    "HERSampleUnit",
    "HERWriter",
    "HindsightBase",
    "HindsightOptions",
    "TransitionKeys",
    "WriterCounts",
    "draw_goals",
    "find_episodes",
    "index_episodes",
]
