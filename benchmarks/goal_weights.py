"""Measures how long the weights of 10,000 virtual goals take, with each of the library's weights.

python benchmarks/goal_weights.py --out goal_weights.md
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from machine import describe, one_core, publish, table

GOALS, REAL, WRITTEN = 10_000, 1_000, 2_400


def measure(width: int, rounds: int) -> dict[str, tuple[float, float]]:
    """Returns the least seconds of weighing goals, and of an update, for goals of ``width`` coordinates."""
    import torch  # noqa: PLC0415  # after the process was put on one core

    from torchrl_her import GoalGrid, GoalWeights, Instructiveness  # noqa: PLC0415
    from torchrl_her.goals import (  # noqa: PLC0415
        KernelInstructiveness,
        NetworkNovelty,
        RareGoals,
        sampled_target,
    )

    torch.set_num_threads(1)
    generator = torch.Generator().manual_seed(0)
    real, goals, written = (torch.randn(n, width, generator=generator) for n in (REAL, GOALS, WRITTEN))
    measures: dict[str, GoalWeights] = {
        "rare, by kernel": RareGoals(estimator="kernel"),
        "rare, by neighbors": RareGoals(estimator="neighbors"),
        "IBS, by kernel": KernelInstructiveness(real, sigma=0.5),
        "RND": NetworkNovelty(seed=0),
    }
    if width <= 3:
        grid = GoalGrid([-4.0] * width, [4.0] * width, [20] * width, warn=False)
        measures["IBS, by grid"] = Instructiveness(grid, partial(sampled_target, grid, real), sigma=0.5)
    found = {}
    for name, own in measures.items():
        weighing, telling = [], []
        own.update(goals)
        for _ in range(rounds):
            began = time.perf_counter()
            own.update(written)
            between = time.perf_counter()
            own(goals)
            telling.append(between - began)
            weighing.append(time.perf_counter() - between)
        found[name] = min(weighing), min(telling)
    return found


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=9, help="times that each is measured")
    parser.add_argument("--out", type=Path, help="a Markdown file to write the table to, too")
    options = parser.parse_args(arguments)
    with one_core():
        few, many = (measure(width, options.rounds) for width in (3, 30))
    rows = []
    for name, own in few.items():
        wide = f"{1e3 * many[name][0]:.1f}" if name in many else ""
        rows.append([name, f"{1e3 * own[0]:.1f}", wide, f"{1e3 * own[1]:.1f}"])
    header = ["weights", "of goals of 3 numbers, ms", "of 30 numbers, ms", f"told of {WRITTEN:,} goals, ms"]
    publish(f"{describe('torch')}\n\n{table(header, rows)}", options.out)


if __name__ == "__main__":
    main()
