"""Compares frames/s of a learner with a collecting process, and of one process that does both in turn.

    python benchmarks/run.py parallel.processes

First, a single process measures how long collecting and learning take per frame. From these times follow the
number of frames for each gradient step at which both take equally long, and the largest possible speedup by
a second process: the sum of both times, divided by the longer time. Then the loops are timed in turns.
"""

from __future__ import annotations

import argparse
import logging
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from machine import describe, publish, table

from torchrl_her.trainers.trainer import Trainer
from torchrl_her_recipes import Components, Recipe, build, load_preset, make_recipe

PRESET = Path(__file__).parents[1] / "presets" / "fetch_push.yaml"
BATCHES = 50  # batches in a timed call: an epoch of the preset; the learner waits for the first batch
KINDS: dict[str, dict[str, Any]] = {
    "one process": {},
    "one collects, sync": {"processes": 1},
    "one collects, async": {"processes": 1, "sync": False},
}


@dataclass
class Shares:
    """Seconds per frame for collecting, for writing to the buffer, and for learning."""

    collect: float
    write: float
    learn: float
    frames_per_update: float

    @property
    def most(self) -> float:
        """Largest possible speedup by a second process."""
        other = self.write + self.learn
        return (self.collect + other) / max(self.collect, other)

    def balanced(self) -> float:
        """Returns the frames per gradient step at which collecting takes as long as writing and learning."""
        update = self.learn * self.frames_per_update
        return max(round(update / (self.collect - self.write), 2), 0.05)


class Loop:
    """A training loop; each call continues it."""

    def __init__(self, recipe: Recipe) -> None:
        self.components: Components = build(recipe)
        self.trainer: Trainer = self.components.trainer()
        config = recipe.collection
        self.frames = BATCHES * config.num_envs * config.steps_per_batch
        self.trainer.run(config.warmup_frames + self.frames // 10)  # first writes allocate memory

    def __call__(self) -> float:
        """Trains for ``BATCHES`` batches, and returns frames/s."""
        began = time.perf_counter()
        self.trainer.run(self.frames)
        return self.frames / (time.perf_counter() - began)

    def shares(self) -> Shares:
        """Measures how long collecting, writing and learning take in a single process."""
        trainer, seconds = self.trainer, {"collect": 0.0, "learn": 0.0}
        with (
            _timed(trainer.collector, "next", seconds, "collect"),
            _timed(trainer, "_learn", seconds, "learn"),
        ):
            rate = self()
        collect, learn = (own / self.frames for own in seconds.values())
        return Shares(collect, 1.0 / rate - collect - learn, learn, trainer.frames_per_update)


@contextmanager
def _timed(owner: Any, name: str, seconds: dict[str, float], key: str) -> Iterator[None]:
    work: Callable[..., Any] = getattr(owner, name)

    def timed(*arguments: Any) -> Any:
        began = time.perf_counter()
        out = work(*arguments)
        seconds[key] += time.perf_counter() - began
        return out

    setattr(owner, name, timed)
    yield
    delattr(owner, name)


def compare(recipe: Recipe, repeats: int) -> tuple[Shares, dict[str, list[float]]]:
    """Returns the times per frame in one process, and frames/s of each kind of loop, timed in turns."""
    loops = {name: Loop(recipe.replace(**options)) for name, options in KINDS.items()}
    shares = loops["one process"].shares()
    rates: dict[str, list[float]] = {name: [] for name in loops}
    for _ in range(repeats):
        for name, loop in loops.items():
            rates[name].append(loop())
    for loop in loops.values():
        loop.components.close()
    return shares, rates


def report(cases: dict[str, tuple[Shares, dict[str, list[float]]]]) -> str:
    rows = []
    for name, (shares, rates) in cases.items():
        alone = statistics.median(rates["one process"])
        gains = [f"{statistics.median(values) / alone:.2f}" for values in list(rates.values())[1:]]
        whole = shares.collect + shares.write + shares.learn
        parts = [f"{100 * part / whole:.0f} %" for part in (shares.collect, shares.write, shares.learn)]
        rows.append(
            [name, f"{shares.frames_per_update:g}", *parts, f"{alone:,.0f}", f"{shares.most:.2f}", *gains]
        )
    header = [
        "setting",
        "frames a gradient step",
        "collecting",
        "writing",
        "learning",
        "frames/s, one process",
    ]
    more = ["at most, times", "sync, times", "async, times"]
    repeats = len(next(iter(cases.values()))[1]["one process"])
    return (
        f"FetchPush-v4 with the options of `benchmarks/presets/fetch_push.yaml`; medians of {repeats} "
        f"pieces of {BATCHES} batches, taken in turns. "
        f"{describe('torch', 'torchrl', 'gymnasium-robotics', 'mujoco')}\n\n" + table([*header, *more], rows)
    )


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--repeats", type=int, default=7, help="timed pieces of each loop")
    parser.add_argument("--out", type=Path, help="a Markdown file to write the table to, too")
    options = parser.parse_args(arguments)
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    torch.set_num_threads(1)
    preset = make_recipe(load_preset(str(PRESET)))
    cases = {"the preset": compare(preset, options.repeats)}
    balanced = preset.replace(frames_per_update=cases["the preset"][0].balanced())
    cases["both take equally long"] = compare(balanced, options.repeats)
    publish(report(cases), options.out)


if __name__ == "__main__":
    main()
