"""Writes a table of how long each part of `make demo` takes; the parts add up to the wall-clock time.

python benchmarks/demo_time.py
"""

# ruff: noqa: E402  (the time that imports take is a part of it)
from __future__ import annotations

import time

_BEGAN = time.perf_counter()  # before torch is imported, since the import is one of the parts

import argparse
import tempfile
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

from machine import describe, publish, table

import torchrl_her.trainers.trainer
from torchrl_her_recipes import build, make_recipe, run
from torchrl_her_recipes.config.presets import load_preset
from torchrl_her_recipes.runs import run as run_module

_IMPORTED = time.perf_counter()


class Parts:
    """Seconds of each part. Time in a part that runs within another part counts for the inner part only."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self._open: list[str] = []
        self._since = time.perf_counter()

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        self._switch()
        self._open.append(name)
        try:
            yield
        finally:
            self._switch()
            self._open.pop()

    def timed(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def wrapped(*args: Any, **kwargs: Any) -> Any:
            with self.part(name):
                return function(*args, **kwargs)

        return wrapped

    def _switch(self) -> None:
        now = time.perf_counter()
        if self._open:
            self.seconds[self._open[-1]] += now - self._since
        self._since = now


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--epochs", type=int, help="of the run (default: those of the demo)")
    parser.add_argument("--out", type=Path, help="a file for the table")
    options = parser.parse_args(arguments)
    asked = {} if options.epochs is None else {"epochs": options.epochs}
    parts = Parts()
    with tempfile.TemporaryDirectory() as folder, parts.part("everything else"):
        with parts.part("making environments, networks and buffer"):
            components = build(make_recipe(load_preset("demo"), **asked))
        trainer = components.trainer()
        loop = torchrl_her.trainers.trainer.Trainer
        for owner, name, part in (
            (components.collector, "next", "collecting"),
            (components.buffer, "extend", "writing with hindsight"),
            (components.buffer, "sample", "drawing transitions"),
            (components.buffer, "update_tensordict_priority", "setting priorities"),
        ):
            setattr(owner, name, parts.timed(part, getattr(owner, name)))
        learner = trainer.learner
        learner.update = parts.timed("gradient steps", learner.update)  # type: ignore[method-assign]
        replaced = {
            "play_greedily": "evaluation",
            "measure": "evaluation",
            "save_checkpoint": "checkpoints",
            "goal_map": "map of goals",
            "plot_curves": "pictures",
            "plot_goals": "pictures",
            "film_policy": "pictures",
        }
        patches = [
            patch.object(run_module, name, parts.timed(part, getattr(run_module, name)))
            for name, part in replaced.items()
        ]
        patches.append(patch.object(type(components), "trainer", lambda _self: trainer))
        patches.append(
            patch.object(loop, "_reset_collector", parts.timed("collecting", loop._reset_collector))
        )
        for own in patches:
            own.start()
        try:
            result = run(components, Path(folder) / "run")
        finally:
            for own in patches:
                own.stop()
    total = time.perf_counter() - _BEGAN
    parts.seconds["importing torch and TorchRL"] = _IMPORTED - _BEGAN
    rest = total - sum(parts.seconds.values())
    rows = sorted(parts.seconds.items(), key=lambda pair: -pair[1])
    lines = table(
        ("part", "seconds", "share"),
        [
            *((name, f"{seconds:.1f}", f"{seconds / total:.0%}") for name, seconds in rows),
            ("not measured", f"{rest:.1f}", f"{rest / total:.0%}"),
            ("**all**", f"{total:.1f}", ""),
        ],
    )
    training = result.rows[-1]["seconds"]
    publish(
        f"{describe('torch', 'torchrl')}\n\n{lines}\n\n"
        f"Training and evaluation take {training:.0f} seconds; success {result.success:.0%}.",
        options.out,
    )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
