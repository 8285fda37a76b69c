"""Makes the pictures and the table of RESULTS.md from finished runs.

    python docs/make_results.py runs/results

expects the folders hand_v0_her, robot_v0_her, hand_v2_her and hand_v2_filtered_her in there, and for the
choices that the agent leaves open batch_norm and hard_copy.
"""

from __future__ import annotations

import argparse
import csv
import statistics
from pathlib import Path

import torch
from matplotlib.figure import Figure
from torch import Tensor

from torchrl_her import load_checkpoint
from torchrl_her_envs import make_env
from torchrl_her_recipes.plots import draw_curve, draw_goals

IMAGES = Path(__file__).parent / "images"
RUNS = {
    "hand_v0, her": ("hand_v0_her", "#2b6cb0"),
    "robot_v0, her": ("robot_v0_her", "#38a169"),
    "hand_v2, her": ("hand_v2_her", "#dd6b20"),
    "hand_v2, filtered_her": ("hand_v2_filtered_her", "#805ad5"),
}
CHOICES = {
    "as it is": ("hand_v0_her", "#2b6cb0"),
    "batch normalisation": ("batch_norm", "#dd6b20"),
    "hard copies": ("hard_copy", "#38a169"),
}
FLOOR = -0.9  # shown coordinate below which a ball lies on the floor, or nearly


def read(path: Path) -> list[dict[str, float]]:
    """The metrics of a run."""
    with open(path / "metrics.csv", newline="") as file:
        return [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]


def last(rows: list[dict[str, float]], epochs: int = 3) -> list[float]:
    """Each run's success, mean of its last few evaluations."""
    end, runs = rows[-1]["epoch"], sorted({row["run"] for row in rows})
    recent = [row for row in rows if row["epoch"] > end - epochs]
    return [statistics.mean(row["success"] for row in recent if row["run"] == run) for run in runs]


def goals_of(path: Path) -> Tensor:
    """The virtual goals [n, 2] in the buffers of all runs."""
    rows = [buffer["rows"] for buffer in load_checkpoint(path / "checkpoint.pt")["buffers"]]
    return torch.cat([own["desired_goal"][own["virtual"].squeeze(-1)] for own in rows])


def draw_success(folder: Path) -> None:
    """Curves of all runs, and the table."""
    figure = Figure(figsize=(11, 4), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    print("| task and algorithm | frames | median | over the whole run | each run |")
    print("| --- | --- | --- | --- | --- |")
    for label, (name, colour) in RUNS.items():
        rows = read(folder / name)
        draw_curve(right if "v2" in name else left, rows, "success", colour=colour, label=label)
        each = last(rows)
        listed = ", ".join(f"{value:.0%}" for value in sorted(each))
        whole = statistics.median(last(rows, epochs=10**6))
        frames = f"{rows[-1]['frames']:,.0f}"
        print(f"| {label} | {frames} | {statistics.median(each):.0%} | {whole:.0%} | {listed} |")
    for axes in (left, right):
        axes.set(xlabel="environment steps of each run", ylim=(-0.02, 1.02))
        axes.grid(alpha=0.3)
        axes.legend(loc="upper left")
    left.set_ylabel("success rate (median, 33rd to 67th percentile)")
    figure.savefig(IMAGES / "success.png", dpi=100)


def draw_choices(folder: Path) -> None:
    """Batch normalisation and hard target updates, beside the defaults."""
    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.subplots()
    for label, (name, colour) in CHOICES.items():
        draw_curve(axes, read(folder / name), "success", colour=colour, label=label)
    axes.set(xlabel="environment steps of each run", ylabel="success rate, hand_v0, her", ylim=(-0.02, 1.02))
    axes.grid(alpha=0.3)
    axes.legend(loc="upper left")
    figure.savefig(IMAGES / "choices.png", dpi=100)


def draw_goal_maps(folder: Path) -> None:
    """Where the virtual goals of hand_v2 lie, with and without the filter."""
    env = make_env("hand_v2")
    figure = Figure(figsize=(9, 4.6), layout="constrained")
    for axes, label in zip(figure.subplots(1, 2), ("hand_v2, her", "hand_v2, filtered_her"), strict=True):
        goals = goals_of(folder / RUNS[label][0])
        floor = (goals[:, 1] < FLOOR).float().mean().item()
        draw_goals(axes, goals, env)
        axes.set_title(f"{label}: {floor:.0%} of {len(goals):,} on the floor", fontsize=10)
    figure.savefig(IMAGES / "virtual_goals.png", dpi=100)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", type=Path, help="folder that the runs lie in")
    folder = parser.parse_args().runs
    draw_success(folder)
    draw_goal_maps(folder)
    draw_choices(folder)


if __name__ == "__main__":
    main()
