"""Compares replay of several runs in one buffer with an ordinary buffer and a call for each run.

python benchmarks/replay_speed.py --out replay_speed.md

Both contenders store the same rows, which look like ``hand_v1``, relabel with the filter and k = 4, and
sample by priority. The ordinary buffers are TorchRL's, with this library's ``HERWriter`` and TorchRL's own
storage and ``PrioritizedSampler``; samples are stacked, as a learner of several runs needs them. Both
contenders return contiguous rows, so that the learner need not copy them.
"""

from __future__ import annotations

import argparse
import logging
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from machine import CLOCKS, describe, medians, one_core, publish, table
from tensordict import TensorDictBase
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import PrioritizedSampler

from torchrl_her import EnvReward, HERWriter
from torchrl_her.replay_buffers import PackedStorage, RunsPrioritizedSampler
from torchrl_her_envs import ThrowingEnv, make_env

ENVS, STEPS, EPISODE = 64, 10, 50  # environments of each run; steps of a batch and of an episode
BATCH, CAPACITY = 256, 100_000
NOT_STORED = ("state", "achieved_goal", "collector")  # as in the recipes
ALPHA, BETA = 0.3, 0.4
PRIORITY = "td_error"

Work = Callable[[], int]


def collect(env: ThrowingEnv, runs: int) -> list[TensorDictBase]:
    """Collects an episode of each environment as batches [R * N, T]; balls are set on random walks."""
    collector = Collector(env, frames_per_batch=runs * ENVS * STEPS, total_frames=-1)
    walk = (torch.randn(runs * ENVS, EPISODE + 1, 2) * env.threshold).cumsum(1)
    batches = []
    for begin in range(0, EPISODE, STEPS):
        batch = collector.next().clone()
        batch["achieved_goal"] = walk[:, begin : begin + STEPS].contiguous()
        batch["next", "achieved_goal"] = walk[:, begin + 1 : begin + STEPS + 1].contiguous()
        ends = torch.full_like(batch["done"], False)
        ends[:, -1] = begin + STEPS == EPISODE
        batch["next"].update({"done": ends, "truncated": ends, "terminated": torch.zeros_like(ends)})
        batch["collector", "traj_ids"] = (
            torch.arange(runs * ENVS).unsqueeze(-1).expand(-1, STEPS).contiguous()
        )
        batches.append(batch)
    return batches


def make_writer(env: ThrowingEnv, **options: Any) -> HERWriter:
    reward = EnvReward.of(env)
    return HERWriter(reward, k=4, filter_achieved=True, exclude=NOT_STORED, **options)


def make_one(env: ThrowingEnv, runs: int) -> TensorDictReplayBuffer:
    """Makes one buffer for all runs."""
    shared: dict[str, Any] = {
        "runs": runs,
        "generators": [torch.Generator().manual_seed(run) for run in range(runs)],
    }
    return TensorDictReplayBuffer(
        storage=PackedStorage(runs * CAPACITY),
        writer=make_writer(env, **shared),
        sampler=RunsPrioritizedSampler(CAPACITY, ALPHA, BETA, **shared),
        priority_key=PRIORITY,
    )


def make_many(env: ThrowingEnv, runs: int) -> list[TensorDictReplayBuffer]:
    """Makes an ordinary buffer for each run."""
    buffers = []
    for run in range(runs):
        buffer = TensorDictReplayBuffer(
            storage=LazyTensorStorage(CAPACITY),
            writer=make_writer(env),
            sampler=PrioritizedSampler(CAPACITY, ALPHA, BETA),
            priority_key=PRIORITY,
        )
        buffer.set_rng(torch.Generator().manual_seed(run))
        buffers.append(buffer)
    return buffers


def write_one(buffer: TensorDictReplayBuffer, batches: list[TensorDictBase]) -> int:
    for batch in batches:
        buffer.extend(batch.copy())
    return 1


def write_many(buffers: list[TensorDictReplayBuffer], batches: list[TensorDictBase]) -> int:
    for batch in batches:
        for buffer, block in zip(buffers, batch.chunk(len(buffers)), strict=True):
            buffer.extend(block)
    return 1


def draw_one(buffer: TensorDictReplayBuffer, runs: int, size: int) -> int:
    """Samples rows [R, size] and sets their priorities, as the trainer does."""
    drawn = buffer.sample(runs * size)
    rows = drawn.view(runs, size).contiguous()
    own = drawn.select("index")
    own.set(PRIORITY, rows["next", "reward"].abs().flatten())
    buffer.update_tensordict_priority(own)
    return 1


def draw_many(buffers: list[TensorDictReplayBuffer], size: int) -> int:
    drawn = [buffer.sample(size) for buffer in buffers]
    rows = (torch.stack(drawn) if len(drawn) > 1 else drawn[0].unsqueeze(0)).contiguous()
    for buffer, own, priority in zip(buffers, drawn, rows["next", "reward"].abs().flatten(1), strict=True):
        own.set(PRIORITY, priority)
        buffer.update_tensordict_priority(own)
    return 1


def measure(runs: int, repeats: int, clock: str) -> list[list[str]]:
    """Measures both contenders; returns rows of the table for a number of runs."""
    env = make_env("hand_v1", num_envs=runs * ENVS, seed=0)
    batches, one, many = collect(env, runs), make_one(env, runs), make_many(env, runs)
    while len(many[0]) < CAPACITY:  # full, so that no timed work touches memory for the first time
        write_one(one, batches)
        write_many(many, batches)
    works: dict[str, tuple[Work, Work]] = {
        f"writing an episode of {ENVS} environments, {STEPS} steps at a time": (
            partial(write_one, one, batches),
            partial(write_many, many, batches),
        )
    }
    for steps in (1, 8):
        works[f"drawing {steps} x {BATCH} rows and setting priorities"] = (
            partial(draw_one, one, runs, steps * BATCH),
            partial(draw_many, many, steps * BATCH),
        )
    rows = []
    for name, (ours, theirs) in works.items():
        seconds = medians({"one": ours, "many": theirs}, repeats=repeats, clock=clock, warm_up=2)
        rows.append(
            [
                str(runs),
                name,
                f"{seconds['one'] * 1e3:.2f}",
                f"{seconds['many'] * 1e3:.2f}",
                f"{seconds['many'] / seconds['one']:.1f}",
            ]
        )
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--runs", type=int, nargs="+", default=[1, 15], help="numbers of runs (%(default)s)")
    parser.add_argument("--repeats", type=int, default=15, help="of each work, in turns (%(default)s)")
    parser.add_argument("--clock", choices=CLOCKS, default="wall", help="which time (%(default)s)")
    parser.add_argument("--out", type=Path, help="a Markdown file to write the table to, too")
    options = parser.parse_args(arguments)
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    torch.set_num_threads(1)
    torch.manual_seed(0)
    with one_core():
        rows = [row for runs in options.runs for row in measure(runs, options.repeats, options.clock)]
    header = ["runs", "work", "one buffer, ms", "a buffer for each run, ms", "times as fast"]
    made = f"Medians of {options.repeats}, taken in turns. {describe('torch', 'torchrl')}."
    publish(f"{made}\n\n{table(header, rows)}", options.out)


if __name__ == "__main__":
    main()
