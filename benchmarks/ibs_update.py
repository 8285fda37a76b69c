"""Measures how far virtual goals are from the target q* if q is updated once for each batch or episode.

    python benchmarks/ibs_update.py --out ibs_update.md

The same episodes of `hand_v0` (random actions) are written by HER-IBS with batches of several sizes.
"""

from __future__ import annotations

import argparse
import logging
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import torch
from machine import describe, publish, table
from tensordict import TensorDictBase
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from torchrl_her import EnvReward, GoalGrid, HERWriter, Instructiveness, box_target
from torchrl_her_envs import ThrowingEnv, make_env

EPISODES, AT_ONCE = 1_024, (1, 16, 64, 1_024)
GRID = GoalGrid((-1.0, -1.0), (1.0, 1.0), (20, 20))


def write(env: ThrowingEnv, episodes: TensorDictBase, at_once: int) -> tuple[float, float]:
    """Writes episodes, ``at_once`` in a call; returns the final KL(q || q*) and the seconds of writing."""
    goals = env.goal_distribution
    weights = Instructiveness(
        GRID, partial(box_target, GRID, goals.low, goals.high), sigma=0.4, start_factor=1.0
    )
    reward = EnvReward.of(env)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(EPISODES * 300), writer=HERWriter(reward, weights=weights)
    )
    buffer.set_rng(torch.Generator().manual_seed(0))
    began = time.perf_counter()
    for batch in episodes.split(at_once):
        buffer.extend(batch.copy())
    return weights.divergence, time.perf_counter() - began


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path, help="a Markdown file to write the table to, too")
    options = parser.parse_args(arguments)
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    torch.set_num_threads(1)
    torch.manual_seed(0)
    env = make_env("hand_v0", num_envs=EPISODES)
    episodes = env.rollout(env.world.max_steps, break_when_any_done=False)
    episodes = episodes.exclude("state", ("next", "state"))
    rows = []
    for at_once in AT_ONCE:
        divergence, seconds = write(env, episodes, at_once)
        rows.append([f"{at_once:,}", f"{divergence:.3f}", f"{seconds:.2f}"])
    text = "\n\n".join(
        (describe("torch", "torchrl"), table(("episodes a batch", "KL(q, q*)", "seconds"), rows))
    )
    publish(text, options.out)


if __name__ == "__main__":
    main()
