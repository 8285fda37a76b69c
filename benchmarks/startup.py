"""Seconds until a new Python process is ready, beside what the libraries below need by themselves.

python benchmarks/startup.py --out startup.md
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from machine import describe, medians, publish, table

PROGRAMS = {
    "import torch": ["-c", "import torch"],
    "import torchrl.data, .collectors, .objectives": [
        "-c",
        "import torchrl.data, torchrl.collectors, torchrl.objectives",
    ],
    "import torchrl_her": ["-c", "import torchrl_her"],
    "the parts of a recipe, ready to train": [
        "-c",
        "from torchrl_her_recipes import Recipe; Recipe().build()",
    ],
    "torchrl-her list": ["-m", "torchrl_her_recipes", "list"],
    "Stable-Baselines3's DDPG and HER, imported": [
        "-c",
        "from stable_baselines3 import DDPG, HerReplayBuffer",
    ],
}


def start(program: Sequence[str]) -> Callable[[], int]:
    def work() -> int:
        subprocess.run([sys.executable, *program], check=True, capture_output=True)
        return 1

    return work


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--repeats", type=int, default=3, help="starts of each")
    parser.add_argument("--out", type=Path, help="a Markdown file to write the table to, too")
    options = parser.parse_args(arguments)
    work = {name: start(program) for name, program in PROGRAMS.items()}
    for first in work.values():
        first()  # reads the files from disk
    seconds = medians(work, repeats=options.repeats)
    rows = [[name, f"{value:.1f}"] for name, value in seconds.items()]
    text = "\n\n".join((describe("torch", "torchrl", "stable-baselines3"), table(("start", "seconds"), rows)))
    publish(text, options.out)


if __name__ == "__main__":
    main()
