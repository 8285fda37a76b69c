"""Compares a GPU with one core: gradient steps, a hundred runs as one program, and memory.

    python benchmarks/gpu.py --out bench_gpu.md
    python benchmarks/gpu.py --small

The benchmark takes less than ten minutes. Without a GPU the tables have "not measured" for its figures, and
figures of the CPU only, with fewer runs and frames. A gradient step is one of the training loop: transitions
are drawn by their priorities, learned from, and get new priorities.
"""

from __future__ import annotations

import argparse
import csv
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import torch
from machine import describe, one_core, publish, table
from peers.ours import Ours

from torchrl_her_recipes import Recipe, load_preset, make_recipe
from torchrl_her_recipes.config.shortcuts import merge

NOT_MEASURED = "not measured"
STEPS = 64  # gradient steps in a measurement: two samples of the replay buffer
REPEATS = 5
AIM, MINUTES = 0.9, 5.0


class Setting(NamedTuple):
    """Number of runs, and options, for which gradient steps are measured."""

    name: str
    runs: int
    options: dict[str, object]


NARROW = {"hidden": 64, "batch_size": 256, "frames_per_update": 5}
WIDE = {"hidden": 256, "batch_size": 256, "norm": "layer"}
SETTINGS = (
    Setting("1 run, 3 x 64", 1, NARROW),
    Setting("15 runs, 3 x 64", 15, NARROW),
    Setting("100 runs, 3 x 64", 100, NARROW),
    Setting("1 run, 3 x 256, layer norm (the default agent)", 1, WIDE),
    Setting("5 runs, 3 x 256, layer norm", 5, WIDE),
)
WAYS = {"launched one by one": "never", "CUDA graphs": "auto", "torch.compile, CUDA graphs": "always"}


def recipe_of(setting: Setting, device: str, compile: str) -> Recipe:
    values: dict[str, Any] = {
        "task": "hand_v1",
        "algo": "her",
        "epochs": 1_000,
        "buffer_size": 100_000,
        **setting.options,
    }
    values = merge(load_preset("throwing"), values)
    return make_recipe(values, num_runs=setting.runs, **{"learner.device": device, "compile": compile})


def seconds_a_step(recipe: Recipe) -> float:
    """Returns a gradient step's median seconds, after two measurements that compile and record it."""
    ours = Ours(recipe)
    ours.fill(recipe.collection.num_envs * 50)
    times = []
    for _ in range(2 + REPEATS):
        began = time.perf_counter()
        steps = ours.gradient_steps(STEPS)
        if recipe.learner.device != "cpu":
            torch.cuda.synchronize()
        times.append((time.perf_counter() - began) / steps)
    return median(times[2:])


def steps_table(*, small: bool) -> str:
    """Writes a table of milliseconds of a gradient step, by setting and device."""
    there = torch.cuda.is_available()
    rows = []
    for setting in SETTINGS:
        if small and setting.runs > 15:
            rows.append([setting.name, *[NOT_MEASURED] * (len(WAYS) + 2)])
            continue
        core = seconds_a_step(recipe_of(setting, "cpu", "auto"))
        on_gpu = [seconds_a_step(recipe_of(setting, "cuda", way)) if there else None for way in WAYS.values()]
        best = min((each for each in on_gpu if each is not None), default=None)
        shown = [NOT_MEASURED if each is None else f"{1e3 * each:.2f}" for each in on_gpu]
        gain = NOT_MEASURED if best is None else f"{core / best:.1f}x"
        rows.append([setting.name, f"{1e3 * core:.2f}", *shown, gain])
    header = ["ms of a gradient step, batch 256", "one core (C++)", *WAYS, "best over one core"]
    return table(header, rows)


def climb_table(*, small: bool) -> str:
    """Measures how long 100 runs of ``hand_v1``, as one program, take to a median success of 90 %."""
    there = torch.cuda.is_available()
    options = ["preset=demo", "algo=cher", "checkpoint_interval=1000"]
    if there and not small:
        options += ["num_runs=100", "learner.device=cuda", f"threads={os.cpu_count()}"]
    else:
        options += ["num_runs=2", "epochs=2", "epoch_frames=2560", "threads=1"]
    seconds, found, memory = climb(options)
    if there and not small:
        took = f"{seconds:,.0f} s" if found >= AIM else f"{found:.0%} after {seconds:,.0f} s"
        return table(["100 runs of hand_v1, cher", "memory of the GPU"], [[took, memory]])
    print(f"(2 runs on the CPU end after {seconds:.0f} s)")
    return table(["100 runs of hand_v1, cher", "memory of the GPU"], [[NOT_MEASURED, NOT_MEASURED]])


def climb(options: Sequence[str]) -> tuple[float, float, str]:
    """Trains up to the success ``AIM``, or for some minutes; returns seconds, median success and memory."""
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        command = [sys.executable, "-m", "torchrl_her_recipes", "train", *options, f"folder={run}"]
        began, found, memory = time.perf_counter(), 0.0, 0
        others = memory_in_use()  # memory of other programs and of this one
        errors = Path(folder) / "errors"
        with (
            open(errors, "w") as said,
            subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=said) as program,
        ):
            while program.poll() is None and found < AIM and time.perf_counter() - began < 60 * MINUTES:
                time.sleep(0.5)
                found = last_median(run / "metrics.csv")
                memory = max(memory, memory_in_use() - others)
            seconds = time.perf_counter() - began
            if program.poll():
                raise RuntimeError(f"the run failed: {errors.read_text()[-500:]}")
            program.kill()
    return seconds, found, f"{memory / 1e9:.1f} GB"


def memory_in_use() -> int:
    """Returns the bytes of GPU memory that all programs use together; 0 without a GPU."""
    if not torch.cuda.is_available():
        return 0
    free, every = torch.cuda.mem_get_info()
    return every - free


def last_median(path: Path) -> float:
    """Returns the median success of the runs in their last epoch; 0 before the first evaluation."""
    if not path.is_file():
        return 0.0
    with open(path, newline="") as file:
        rows = list(csv.DictReader(file))
    return median(float(row["success"]) for row in rows if row["epoch"] == rows[-1]["epoch"]) if rows else 0.0


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, help="a Markdown file to write the tables to, too")
    parser.add_argument("--small", action="store_true", help="as where there is no GPU")
    options = parser.parse_args(arguments)
    small = options.small or not torch.cuda.is_available()
    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else f"GPU: {NOT_MEASURED}"
    torch.set_num_threads(1)
    with one_core():
        steps = steps_table(small=small)
    text = [f"{describe('torch', 'torchrl')}; {gpu}", steps, climb_table(small=small)]
    publish("\n\n".join(text), options.out)


if __name__ == "__main__":
    main()
