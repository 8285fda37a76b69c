"""Compares the time of writing with hindsight with TorchRL's plain writer, for the same number of rows.

    python benchmarks/writer_speed.py --out writer_speed.md

A batch of 800 episodes of 50 steps is written in one call. With k = 4 virtual rows for each real one
that makes 200,000 rows; the plain writer gets the same 200,000 rows, ready-made. Filtered HER writes
the same batch, and one in which no ball moves, so that the filter drops all virtual goals.
The checks that HERWriter makes of each write, that goals and rewards are finite, are timed alone, too.
"""

from __future__ import annotations

import argparse
import logging
import statistics
import time
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import torch
from machine import describe
from tensordict import TensorDictBase
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers.writers import RoundRobinWriter, Writer

from torchrl_her import (
    EnvReward,
    GoalGrid,
    GoalWeights,
    HERWriter,
    Instructiveness,
    box_target,
)
from torchrl_her.checks import check_finite
from torchrl_her.goals import GoalHistogram
from torchrl_her_envs import ThrowingEnv, make_env

EPISODES, STEPS, K = 800, 50, 4
ROWS = EPISODES * STEPS * (K + 1)
CAPACITY = 1_000_000
NOT_STORED = ("state", "achieved_goal", "collector")  # as in the recipes

PLAIN, HER, COUNTED, FILTERED, IBS, RESTING, CHECKS = (
    "RoundRobinWriter (TorchRL)",
    "HERWriter",
    "HERWriter that counts its goals, as in recipes",
    "HERWriter, filtered",
    "HERWriter, filtered, IBS",
    "HERWriter, filtered, balls at rest",
    "its checks alone (goals, real and virtual rewards)",
)


def collect(env: ThrowingEnv) -> TensorDictBase:
    """Collects a batch [N, T] of whole episodes, in which random actions move hardly any ball."""
    batch = Collector(env, frames_per_batch=EPISODES * STEPS, total_frames=-1).next()
    last = torch.arange(STEPS) == STEPS - 1
    ends = last.view(1, STEPS, 1).expand(EPISODES, STEPS, 1)
    batch["next"].update({"done": ends, "truncated": ends, "terminated": torch.zeros_like(ends)})
    batch["collector", "traj_ids"] = torch.arange(EPISODES).unsqueeze(-1).expand(EPISODES, STEPS)
    return batch.contiguous()


def move_balls(batch: TensorDictBase, env: ThrowingEnv) -> TensorDictBase:
    """Returns a batch with balls on random walks, with steps of about the threshold, like a fast hand."""
    walk = (torch.randn(EPISODES, STEPS + 1, 2) * env.threshold).cumsum(1)
    moving = batch.clone()
    moving["achieved_goal"], moving["next", "achieved_goal"] = walk[:, :-1], walk[:, 1:]
    return moving.contiguous()


def make_buffer(writer: Writer) -> TensorDictReplayBuffer:
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(CAPACITY), writer=writer, batch_size=64)
    buffer.set_rng(torch.Generator().manual_seed(0))
    return buffer


def make_her(
    env: ThrowingEnv, *, filter_achieved: bool = False, weights: GoalWeights | None = None
) -> HERWriter:
    reward = EnvReward.of(env)
    return HERWriter(reward, k=K, filter_achieved=filter_achieved, weights=weights, exclude=NOT_STORED)


def make_ibs(env: ThrowingEnv, grid: GoalGrid) -> Instructiveness:
    goals = env.goal_distribution
    return Instructiveness(grid, partial(box_target, grid, goals.low, goals.high), sigma=0.4)


def make_cases() -> dict[str, tuple[TensorDictReplayBuffer, TensorDictBase]]:
    """Makes a buffer for each writer, and the batch that it writes, by the writer's name in the table."""
    env = make_env("hand_v1", num_envs=EPISODES, seed=0)
    resting = collect(env)
    moving = move_balls(resting, env)
    grid = GoalGrid((-1.0, -1.0), (1.0, 1.0), (20, 20))
    warnings.filterwarnings("ignore", "goal .* lies outside the grid")  # these balls walk off the screen
    her = make_buffer(make_her(env))
    her.extend(moving.copy())
    ready_made = her[:ROWS].clone()
    return {
        PLAIN: (make_buffer(RoundRobinWriter()), ready_made),
        HER: (her, moving),
        COUNTED: (make_buffer(make_her(env, weights=GoalHistogram(grid))), moving),
        IBS: (make_buffer(make_her(env, filter_achieved=True, weights=make_ibs(env, grid))), moving),
        FILTERED: (make_buffer(make_her(env, filter_achieved=True)), moving),
        RESTING: (make_buffer(make_her(env, filter_achieved=True)), resting),
    }


def write(buffer: TensorDictReplayBuffer, batch: TensorDictBase) -> Callable[[], object]:
    # A shallow copy, since the buffer adds an entry ``index`` to the batch.
    return lambda: buffer.extend(batch.copy())


def checks(buffer: TensorDictReplayBuffer, batch: TensorDictBase) -> Callable[[], object]:
    """Returns a function that makes a writer's checks of a batch and of rewards of virtual transitions."""
    writer, rewards = buffer.writer, torch.zeros(ROWS * K // (K + 1), 1)

    def check() -> None:
        writer._keys.check(batch, "collected", k=K)
        check_finite({"rewards": rewards})

    return check


def rows_of_one_write(buffer: TensorDictReplayBuffer, batch: TensorDictBase) -> int:
    before = buffer.writer._write_count
    buffer.extend(batch.copy())
    return buffer.writer._write_count - before


def warm(buffer: TensorDictReplayBuffer, batch: TensorDictBase) -> None:
    """Fills the buffer, so that no timed write touches memory for the first time."""
    while len(buffer) < CAPACITY:
        buffer.extend(batch.copy())


def interleaved(actions: dict[str, Callable[[], object]], repeats: int) -> dict[str, list[float]]:
    """Measures seconds of each action; they take turns, so a busy machine slows all of them alike."""
    seconds: dict[str, list[float]] = {name: [] for name in actions}
    for _ in range(repeats):
        for name, action in actions.items():
            start = time.perf_counter()
            action()
            seconds[name].append(time.perf_counter() - start)
    return seconds


def report(rows: dict[str, int], seconds: dict[str, list[float]]) -> str:
    middle = {name: statistics.median(values) for name, values in seconds.items()}
    ratio, filtered, resting, ibs = (
        f"{middle[one] / middle[other]:.2f} times"
        for one, other in ((HER, PLAIN), (FILTERED, HER), (RESTING, HER), (IBS, COUNTED))
    )
    lines = [
        f"**HERWriter takes {ratio} as long as the plain writer** (at most 2). With the filter it takes "
        f"{filtered} as long as without (at most 1.5), and {resting} where no ball moves. With IBS and the "
        f"filter it takes {ibs} as long as with neither (at most 1.5), goals being counted in both. Checking "
        f"that goals and rewards are finite takes {middle[CHECKS] / middle[HER]:.1%} of a write (below 2 %).",
        "",
        f"One batch of {EPISODES} episodes of {STEPS} steps, k = {K}, rows as of `hand_v1`; medians of "
        f"{len(seconds[HER])} writes taken in turns. {describe('torch', 'torchrl')}.",
        "",
        "| writer | rows written | ms, median | ms, least | ms, most | million rows/s |",
        "| --- | ---: | ---: | ---: | ---: | ---: |",
    ]
    for name, values in seconds.items():
        lines.append(
            f"| {name} | {rows[name]:,} | {middle[name] * 1e3:.2f} | {min(values) * 1e3:.2f} | "
            f"{max(values) * 1e3:.2f} | {rows[name] / middle[name] / 1e6:.2f} |"
        )
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--repeats", type=int, default=15, help="timed writes of each writer")
    parser.add_argument("--out", type=Path, help="a Markdown file to write the table to, too")
    options = parser.parse_args(arguments)
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    torch.set_num_threads(1)
    torch.manual_seed(0)
    cases = make_cases()
    rows = {name: rows_of_one_write(*case) for name, case in cases.items()}
    for case in cases.values():
        warm(*case)
    actions = {name: write(*case) for name, case in cases.items()}
    actions[CHECKS], rows[CHECKS] = checks(*cases[HER]), ROWS
    table = report(rows, interleaved(actions, options.repeats))
    print(table)
    if options.out is not None:
        options.out.write_text(table + "\n")


if __name__ == "__main__":
    main()
