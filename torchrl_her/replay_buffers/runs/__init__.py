"""Replay of several runs in one buffer: R equal blocks of rows, drawn from and written to in one pass."""

from torchrl_her.replay_buffers.runs.buffer import empty_run, rows_of_run, runs_of, sizes_of
from torchrl_her.replay_buffers.runs.sampler import RunsPrioritizedSampler, RunsSampler
from torchrl_her.replay_buffers.runs.storage import PackedStorage

__all__ = [
    "PackedStorage",
    "RunsPrioritizedSampler",
    "RunsSampler",
    "empty_run",
    "rows_of_run",
    "runs_of",
    "sizes_of",
]
