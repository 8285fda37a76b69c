"""Measures seconds and bytes of checkpoints, and their share of a run's time at the default interval.

python benchmarks/checkpoint_cost.py --runs 1 15 --out checkpoint_cost.md
"""

from __future__ import annotations

import argparse
import logging
import statistics
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import torch
from machine import describe, publish, table

from torchrl_her import save_checkpoint
from torchrl_her.replay_buffers import sizes_of
from torchrl_her_recipes import Recipe, build, load_preset, make_recipe
from torchrl_her_recipes.runs.state import parts_of, run_state


def measure(recipe: Recipe, folder: Path) -> list[str]:
    """Trains with a run's checkpoints, but without evaluations, and returns a row of the table."""
    components = build(recipe)
    trainer, path = components.trainer(), folder / "checkpoint.pt"
    parts, trained, saved = parts_of(components, trainer), 0.0, []
    while trainer.epochs < recipe.run.epochs:
        began = time.perf_counter()
        trainer.epoch()
        trained += time.perf_counter() - began
        if trainer.epochs % recipe.run.checkpoint_interval == 0:
            began = time.perf_counter()
            save_checkpoint(run_state(parts), path, keep=recipe.run.keep_checkpoints)
            saved.append(time.perf_counter() - began)
    trained -= trainer.learner.compile_seconds  # left out, since a machine compiles only once
    rows = statistics.mean(sizes_of(components.buffer))
    return [
        str(recipe.run.num_runs),
        f"{rows:,.0f}",
        f"{path.stat().st_size / 1e6:,.0f}",
        f"{saved[-1]:.2f}",
        f"{sum(saved):.1f} of {trained:.0f} s",
        f"**{sum(saved) / (sum(saved) + trained):.1%}**",
    ]


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--runs", type=int, nargs="+", default=[1, 15], help="how many side by side")
    parser.add_argument(
        "--epochs", type=int, default=make_recipe().run.epochs, help="of each run (%(default)s)"
    )
    parser.add_argument("--out", type=Path, help="a Markdown file to write the table to, too")
    options = parser.parse_args(arguments)
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    torch.set_num_threads(1)
    recipe = make_recipe(load_preset("throwing"), epochs=options.epochs)
    rows = []
    for runs in options.runs:
        with tempfile.TemporaryDirectory(dir=".") as folder:  # not in /tmp, which may be in memory
            rows.append(measure(recipe.replace(num_runs=runs), Path(folder)))
    header = ("runs", "rows of each", "MB", "seconds of the last", "all checkpoints", "share of the time")
    text = "\n\n".join((describe("torch", "torchrl"), table(header, rows)))
    publish(text, options.out)


if __name__ == "__main__":
    main()
