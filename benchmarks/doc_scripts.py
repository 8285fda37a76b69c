"""Writes learning curves of two scripts in the documentation to results/NAME and docs/images/NAME.png.

    python benchmarks/doc_scripts.py own_script    # docs/own_script.md on hand_v0
    python benchmarks/doc_scripts.py recurrent     # docs/examples/recurrent.py, with and without memory

Seeds are trained one after the other. ``--seeds 2`` is for trying it out.
"""

from __future__ import annotations

import argparse
import re
import runpy
import time
from collections.abc import Callable, Iterable, Sequence
from datetime import UTC, datetime
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from matplotlib.figure import Figure

from torchrl_her_recipes.reports.results import Combination
from torchrl_her_recipes.reports.tidy import write_files
from torchrl_her_recipes.runs.plots import colors, count_frames, draw_curve
from torchrl_her_recipes.runs.scores import at_the_end

ROOT = Path(__file__).parents[1]
PAGE, EXAMPLE = ROOT / "docs" / "own_script.md", ROOT / "docs" / "examples" / "recurrent.py"
SUMMARIES = {
    "own_script": "the script of docs/own_script.md",
    "recurrent": "the goal is shown in the first three steps only: a GRU beside a layer without memory",
}
LABELS = {"success": "success", "steps": "steps to the goal, or all 20"}
Row = dict[str, float]


def own_script(seed: int) -> list[Row]:
    """Runs the page's code, up to the end of its training loop, with a given seed; returns its curve."""
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)[:3]
    text, names = "\n".join(blocks), {}
    first = "seed, total_frames = 0,"
    if text.count(first) != 1:
        raise ValueError(f"{PAGE} must set its seed once, by {first!r}")
    exec(compile(text.replace(first, f"seed, total_frames = {seed},"), str(PAGE), "exec"), names)
    return [
        {"epoch": epoch, "frames": frames, "success": success}
        for epoch, (frames, success) in enumerate(names["curve"], start=1)
    ]


def recurrent(seed: int, *, memory: bool) -> Iterable[Row]:
    """Trains the policy of the example, with or without memory; yields its learning curve."""
    return runpy.run_path(str(EXAMPLE))["train"](recurrent=memory, seed=seed)


SCRIPTS: dict[str, dict[str, tuple[str, Callable[[int], Iterable[Row]]]]] = {
    "own_script": {"own_script": ("hand_v0", own_script)},
    "recurrent": {
        "gru": ("hand_reach", partial(recurrent, memory=True)),
        "memoryless": ("hand_reach", partial(recurrent, memory=False)),
    },
}


def measure(label: str, task: str, script: Callable[[int], Iterable[Row]], seeds: int) -> Combination:
    """Runs a script with the seeds 0, 1, ... and returns all its learning curves."""
    rows, began = [], time.process_time()
    for seed in range(seeds):
        for row in script(seed):
            rows.append({"run": seed, "seed": seed, **row})
        print(
            f"{label}, seed {seed}: {rows[-1]['success']:.0%} after {rows[-1]['frames']:,} frames", flush=True
        )
    return combination(label, task, rows, seconds=time.process_time() - began)


def combination(label: str, task: str, rows: list[Row], *, seconds: float) -> Combination:
    """Returns all runs of a script as one combination of a study."""
    ordered = sorted(rows, key=lambda row: (row["epoch"], row["run"]))
    return Combination(
        label=label,
        task=task,
        algorithm=label,
        options={"script": label},
        rows=ordered,
        done=True,
        epochs=int(ordered[-1]["epoch"]),
        planned=len({row["run"] for row in rows}),
        seconds=seconds,
        differs="",
        goals=None,
    )


def publish(name: str, cells: Sequence[Combination], results: Path, images: Path) -> None:
    """Writes the numbers and the picture of the curves, and prints the final value of each metric."""
    about: dict[str, Any] = {
        "study": name,
        "summary": SUMMARIES[name],
        "command": f"python benchmarks/doc_scripts.py {name}",
        "date": datetime.now(UTC).date().isoformat(),
        "versions": {own: version(own) for own in ("torch", "torchrl", "tensordict", "torchrl-her")},
    }
    write_files(about, cells, results / name)
    metrics = [metric for metric in LABELS if cells[0].has(metric)]
    draw(cells, metrics, images / f"{name}.png")
    for cell in cells:
        for metric in metrics:
            print(
                f"{cell.label}: {metric} of each run",
                [round(value, 3) for value in at_the_end(cell.rows, metric)],
            )


def draw(cells: Sequence[Combination], metrics: Sequence[str], path: Path) -> None:
    """Draws median and 33rd to 67th percentile of runs: a panel for each metric, a color for each script."""
    figure = Figure(figsize=(1.0 + 4.2 * len(metrics), 3.8), layout="constrained")
    palette = colors([cell.label for cell in cells])
    for axes, metric in zip(figure.subplots(1, len(metrics), squeeze=False)[0], metrics, strict=True):
        for cell in cells:
            draw_curve(axes, cell.rows, metric, color=palette[cell.label], label=cell.label)
        axes.set(title=cells[0].task, xlabel="environment steps of each run", ylabel=LABELS[metric])
        axes.set_ylim(0.0, 1.02 if metric == "success" else None)
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
        count_frames(axes)
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("name", choices=SCRIPTS)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--results", type=Path, default=ROOT / "results", help="where the numbers go")
    parser.add_argument(
        "--images", type=Path, default=ROOT / "docs" / "images", help="where the picture goes"
    )
    options = parser.parse_args()
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    cells = [
        measure(label, task, script, options.seeds) for label, (task, script) in SCRIPTS[options.name].items()
    ]
    publish(options.name, cells, options.results, options.images)


if __name__ == "__main__":
    main()
