"""Measures the time that proposed goals add to collection, and to the whole training loop.

    python benchmarks/behavior_speed.py --out behavior_speed.md

Five runs of ``preset=demo algo=filtered_her``, one thread. Choices of ``behavior`` take turns in one process.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Sequence
from pathlib import Path

from machine import describe, one_core, publish, table

WAYS = ("real", "uniform_achieved", "ibs", "mega", "discover")
PARTS = ("collecting", "loop")
WARM, TIMED = 9_600, 640  # frames of each run


def measure(rounds: int) -> dict[str, dict[str, float]]:
    """Returns the median seconds of each behavior for collecting a batch, and for a loop over its frames."""
    import torch  # noqa: PLC0415  # after the process was put on one core

    from torchrl_her_recipes import build, make_recipe  # noqa: PLC0415
    from torchrl_her_recipes.config.presets import load_preset  # noqa: PLC0415

    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    parts = {}
    for way in WAYS:
        recipe = make_recipe(load_preset("demo"), algo="filtered_her", num_runs=5, behavior=way)
        collector, trainer = build(recipe).collector, build(recipe).trainer()
        parts[way] = collector, trainer
        for _ in range(WARM // TIMED):
            collector.next()
        trainer.run(WARM)
    found: dict[str, dict[str, list[float]]] = {way: {name: [] for name in PARTS} for way in WAYS}
    for _ in range(rounds):
        for way, (collector, trainer) in parts.items():
            began = time.perf_counter()
            collector.next()
            between = time.perf_counter()
            trainer.run(TIMED)
            for name, seconds in zip(PARTS, (between - began, time.perf_counter() - between), strict=True):
                found[way][name].append(seconds)
    return {way: {name: statistics.median(own[name]) for name in PARTS} for way, own in found.items()}


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=15, help="times that each way is measured")
    parser.add_argument("--out", type=Path, help="a Markdown file to write the table to, too")
    options = parser.parse_args(arguments)
    with one_core():
        found = measure(options.rounds)
    rows = [
        [way, *(f"{own[name] / found['real'][name]:.2f}" for name in PARTS)] for way, own in found.items()
    ]
    header = ["behavior", "collecting, over that with real goals", "the whole loop, over that"]
    publish(f"{describe('torch', 'torchrl')}\n\n{table(header, rows)}", options.out)


if __name__ == "__main__":
    main()
