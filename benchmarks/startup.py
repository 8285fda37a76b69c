"""Measures seconds and memory until a Python process is ready, for this package and libraries that it needs.

python benchmarks/startup.py --out startup.md
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from machine import describe, publish, table

PROGRAMS = {
    "import torch": ["-c", "import torch"],
    "import torchrl.data, .collectors, .objectives": [
        "-c",
        "import torchrl.data, torchrl.collectors, torchrl.objectives",
    ],
    "import torchrl_her": ["-c", "import torchrl_her"],
    "the components of a recipe, ready to train": [
        "-c",
        "from torchrl_her_recipes import build, make_recipe; build(make_recipe())",
    ],
    "torchrl-her --version": ["-m", "torchrl_her_recipes", "--version"],
    "torchrl-her --help": ["-m", "torchrl_her_recipes", "--help"],
    "torchrl-her list": ["-m", "torchrl_her_recipes", "list"],
    "torchrl-her train -h": ["-m", "torchrl_her_recipes", "train", "-h"],
    "torchrl-her train task=hand_v9 (refused)": ["-m", "torchrl_her_recipes", "train", "task=hand_v9"],
    "torchrl-her train epochs=many (refused)": ["-m", "torchrl_her_recipes", "train", "epochs=many"],
    "Stable-Baselines3's DDPG and HER, imported": [
        "-c",
        "from stable_baselines3 import DDPG, HerReplayBuffer",
    ],
}


def start(command: Sequence[str]) -> tuple[float, float]:
    """Runs a command; returns the seconds until it has ended, and its largest memory in MB."""
    began = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    _, _, usage = os.wait4(process.pid, 0)
    scale = 1e6 if sys.platform == "darwin" else 1e3  # in bytes on macOS, in kilobytes elsewhere
    return time.perf_counter() - began, usage.ru_maxrss / scale


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "--repeats", type=int, default=5, help="starts of each, behind one that is not counted"
    )
    parser.add_argument("--python", default=sys.executable, help="an interpreter of another environment")
    parser.add_argument("--only", default="", help="those programs whose names begin so")
    parser.add_argument("--out", type=Path, help="a Markdown file to write the table to, too")
    options = parser.parse_args(arguments)
    rows = []
    for name, program in PROGRAMS.items():
        if name.startswith(options.only):
            start([options.python, *program])  # not timed: reads files from disk and writes bytecode
            starts = [start([options.python, *program]) for _ in range(options.repeats)]
            seconds, memory = (statistics.median(own) for own in zip(*starts, strict=True))
            rows.append([name, f"{seconds:.2f}", f"{memory:,.0f}"])
    header = ("start", "seconds", "MB")
    publish(
        "\n\n".join((describe("torch", "torchrl", "stable-baselines3"), table(header, rows))), options.out
    )


if __name__ == "__main__":
    main()
