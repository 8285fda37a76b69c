"""Measures the bytes of a replay buffer of a million rows, stored as copies or as references.

    python benchmarks/memory.py --out memory.md

Rows are those of `hand_v1` under HER with k = 4. "References" is a sketch of another way to store virtual
rows: as the index of the real row and of the row whose achieved goal is taken; they are built when they are
sampled. It shows sizes and times only, and ignores that real rows may be overwritten before virtual ones.
"""

from __future__ import annotations

import argparse
import logging
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from machine import describe, medians, publish, table
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from writer_speed import EPISODES, NOT_STORED, STEPS, K, collect, move_balls

from torchrl_her import EnvReward, HERWriter
from torchrl_her_envs import make_env

REAL, ROWS = EPISODES * STEPS, EPISODES * STEPS * (K + 1)
MILLION, DRAWN = 1_000_000, 512


def size(rows: TensorDictBase) -> int:
    """Returns the number of bytes of all entries."""
    return sum(entry.nbytes for entry in rows.values(True, True))


class References:
    """Virtual rows, stored as two indices each, before real rows, which refer to themselves."""

    def __init__(self, real: TensorDictBase, reward: EnvReward) -> None:
        self.real, self.reward = real, reward
        step = torch.arange(REAL, dtype=torch.int32)
        of = step.repeat_interleave(K)
        left = STEPS - of % STEPS
        goal = of + (torch.rand(len(of)) * left).int()
        self.index = TensorDict(
            {"row": torch.cat((of, step)), "goal": torch.cat((goal, torch.full_like(step, -1)))}, [ROWS]
        )

    def draw(self, places: Tensor) -> TensorDictBase:
        index = self.index[places]
        rows, virtual = self.real[index["row"]], (index["goal"] >= 0).unsqueeze(-1)
        goals = self.real["next", "achieved_goal"][index["goal"].clamp(min=0)]
        goals = torch.where(virtual, goals, rows["desired_goal"])
        reward, terminated = self.reward(rows["next", "achieved_goal"], goals)
        after = rows["next"]
        rows["desired_goal"] = after["desired_goal"] = goals
        after["reward"] = torch.where(virtual, reward, after["reward"])
        after["terminated"] = torch.where(virtual, terminated, after["terminated"])
        after["done"] = after["terminated"] | after["truncated"]
        return rows


def copies(batch: TensorDictBase, reward: EnvReward) -> TensorDictBase:
    """Returns rows as the library's writer stores them: virtual rows are copies."""
    writer = HERWriter(reward, k=K, exclude=NOT_STORED)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(ROWS), writer=writer)
    buffer.extend(batch.copy())
    return buffer[:].exclude("index")


def timed(draw: Callable[[Tensor], object]) -> Callable[[], int]:
    def work() -> int:
        for _ in range(50):
            draw(torch.randint(ROWS, (DRAWN,)))
        return 50

    return work


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--repeats", type=int, default=9, help="timed draws of each")
    parser.add_argument("--out", type=Path, help="a Markdown file to write the table to, too")
    options = parser.parse_args(arguments)
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    torch.set_num_threads(1)
    torch.manual_seed(0)
    env = make_env("hand_v1", num_envs=EPISODES, seed=0)
    reward = EnvReward.of(env)
    batch = move_balls(collect(env), env)
    stored = copies(batch, reward)
    plain = stored.exclude("virtual")
    keys = [*plain.keys(True, True), ("next", "achieved_goal")]
    references = References(batch.reshape(-1).select(*keys), reward)
    seconds = medians({"c": timed(stored.__getitem__), "r": timed(references.draw)}, repeats=options.repeats)
    sizes = {
        "TorchRL's plain storage of the same rows": (size(plain) / ROWS, ""),
        "HERWriter (copies)": (size(stored) / ROWS, f"{1e3 * seconds['c']:.3f}"),
        "references (a sketch)": (
            (size(references.real) + size(references.index)) / ROWS,
            f"{1e3 * seconds['r']:.3f}",
        ),
        "TorchRL's plain storage of all that is collected": (size(batch) / REAL, ""),
    }
    least = next(iter(sizes.values()))[0]
    rows = [
        [name, f"{own / least:.2f}x", f"{own * MILLION / 1e6:.0f}", ms] for name, (own, ms) in sizes.items()
    ]
    header = ("a million rows", "over plain storage", "MB", f"ms to draw {DRAWN} rows")
    text = "\n\n".join((describe("torch", "torchrl"), table(header, rows)))
    publish(text, options.out)


if __name__ == "__main__":
    main()
