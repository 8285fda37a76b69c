"""Measures time and memory per run, depending on the number of runs that train as one program.

    python benchmarks/many_runs.py --out many_runs.md
    python benchmarks/many_runs.py --runs 100 --full

Each number of runs is measured in a program of its own: the training loop of ``preset=demo algo=cher``, with
one thread. Memory is the program's maximum, and its size with full buffers, computed from their row size.
"""

from __future__ import annotations

import argparse
import json
import math
import resource
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from machine import describe, one_core, publish, table

RUNS = (1, 15, 30, 60, 100)
WARM, TIMED = 6_400, 5_120  # frames of each run


def measure(runs: int, *, full: bool) -> dict[str, float]:
    """Trains runs in this process, first filling buffers if ``full``; returns seconds, bytes and steps."""
    import torch  # noqa: PLC0415  # after the process was put on one core

    from torchrl_her_recipes import build, make_recipe  # noqa: PLC0415
    from torchrl_her_recipes.config.presets import load_preset  # noqa: PLC0415

    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    recipe = make_recipe(load_preset("demo"), algo="cher", num_runs=runs)
    components = build(recipe)
    trainer = components.trainer()
    if full:
        trainer.warmup_frames = math.inf  # type: ignore[assignment]  # nothing is learned meanwhile
        while min(components.buffer.writer.sizes) < recipe.replay.buffer_size:
            trainer.run(TIMED)
        trainer.warmup_frames, trainer._credit = 0, 0.0
    trainer.run(WARM)
    updates, began = trainer.updates, time.perf_counter()
    trainer.run(TIMED)
    seconds = time.perf_counter() - began
    row = components.buffer.storage.packed[0].nbytes
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    stored = sum(components.buffer.writer.sizes)
    return {
        "seconds": seconds,
        "most": most,
        "full": most + row * (runs * recipe.replay.buffer_size - stored),
        "row": row,
        "updates": trainer.updates - updates,
        "share": stored / components.buffer.writer.totals.real,
    }


def line(runs: int, found: dict[str, float], of_base: float) -> list[str]:
    each = found["seconds"] / runs
    return [
        f"{runs}",
        f"{runs * TIMED / found['seconds']:,.0f}",
        f"{1e3 * each / found['updates']:.2f}",
        f"{each / of_base:.2f}",
        f"{found['most'] / 1e9:.1f}",
        f"{found['full'] / 1e9:.1f}",
    ]


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--runs", type=int, nargs="+", default=RUNS)
    parser.add_argument("--full", action="store_true", help="fill all buffers first, which takes minutes")
    parser.add_argument("--only", type=int, help=argparse.SUPPRESS)  # for the process of one measurement
    parser.add_argument("--out", type=Path, help="a Markdown file to write the table to, too")
    options = parser.parse_args(arguments)
    if options.only is not None:
        with one_core():
            print(json.dumps(measure(options.only, full=options.full)))
        return
    found = {}
    for runs in options.runs:
        command = [sys.executable, __file__, "--only", str(runs), *(["--full"] if options.full else [])]
        program = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
        found[runs] = json.loads(program.stdout.splitlines()[-1])
        print(f"{runs} runs: {found[runs]}", flush=True)
    base = 15 if 15 in found else options.runs[0]
    of_base = found[base]["seconds"] / base
    header = [
        "runs",
        "frames/s, all runs",
        "ms of a gradient step and its frames, each run",
        f"times that of one of {base}",
        "GB",
        "GB with full buffers",
    ]
    own = found[base]
    notes = f"A row is {own['row']:.0f} bytes; {own['share']:.1f} rows are stored for each frame."
    rows = [line(runs, found[runs], of_base) for runs in options.runs]
    publish(f"{describe('torch', 'torchrl')}\n\n{table(header, rows)}\n\n{notes}", options.out)


if __name__ == "__main__":
    main()
