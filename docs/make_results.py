"""Makes the pictures, tables and data of RESULTS.md from finished runs.

    python docs/make_results.py runs

Every study reads the folders STUDY/TASK_ALGORITHM in there, leaves out what is missing, prints a table,
draws `images/STUDY.png`, and writes the curves behind it to `results/STUDY_TASK_ALGORITHM.csv`.
"""

from __future__ import annotations

import argparse
import csv
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from torchrl_her_envs import make_env
from torchrl_her_recipes.batches import Batches
from torchrl_her_recipes.plots import draw_goals, plot_comparison
from torchrl_her_recipes.studies import draw_study, load_study
from torchrl_her_recipes.study_results import at_the_end

HERE = Path(__file__).parent
COLUMNS = (
    "run",
    "epoch",
    "frames",
    "updates",
    "success",
    "kl",
    "layer",
    "q_bias",
    "rows_real_positive",
    "rows_useful_virtual_positive",
)

Rows = list[dict[str, float]]


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Tasks beside each other, and the algorithms that are compared on them."""

    tasks: Sequence[str]
    algorithms: Sequence[str]
    goals: bool = False  # whether to draw maps of virtual goals

    @classmethod
    def of_study(cls, name: str, *, goals: bool = False) -> Comparison:
        vary = load_study(name).vary
        return cls(tasks=vary["task"], algorithms=vary["algo"], goals=goals)


COMPARISONS = {
    "v0": Comparison(tasks=("hand_v0", "robot_v0", "hand_wall_v0"), algorithms=("her", "her_ibs")),
    "ibs": Comparison.of_study("ibs", goals=True),
    "bias": Comparison.of_study("bias", goals=True),
    "curriculum": Comparison.of_study("curriculum"),
    "climb": Comparison(tasks=("hand_v1", "hand_wall_v1", "robot_v1"), algorithms=("cher",)),
    "draws": Comparison(tasks=("hand_v0_1", "hand_v0_8", "hand_v0_64"), algorithms=("her",)),
}
OPTIONS = ("window", "initialisation")


def spread(values: Sequence[float], form: str) -> str:
    """The median, and the 33rd to 67th percentile."""
    low, middle, high = np.percentile(values, [33, 50, 67])
    return f"**{middle:{form}}** ({low:{form}} to {high:{form}})"


def read_study(study: Comparison, folder: Path) -> dict[tuple[str, str], Batches]:
    """The runs that there are."""
    found = {}
    for task in study.tasks:
        for algorithm in study.algorithms:
            runs = Batches(folder / f"{task}_{algorithm}")
            if runs.is_done:
                found[task, algorithm] = runs
    return found


def print_table(runs: dict[tuple[str, str], Batches], heads: str = "task | algorithm") -> None:
    print(f"| {heads} | runs | frames | success at the end | worst run | KL(q, q*) |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for (task, algorithm), own in runs.items():
        rows = own.rows()
        success = at_the_end(rows, "success")
        frames = f"{rows[-1]['frames']:,.0f}"
        kl = spread([row["kl"] for row in rows if row["epoch"] == rows[-1]["epoch"]], ".2f")
        print(
            f"| `{task}` | `{algorithm}` | {len(success)} | {frames} | {spread(success, '.0%')} "
            f"| {min(success):.0%} | {kl} |"
        )


def draw_success(runs: dict[tuple[str, str], Batches], path: Path) -> None:
    panels: dict[str, dict[str, Rows]] = {}
    for (task, algorithm), own in runs.items():
        panels.setdefault(task, {})[algorithm] = own.rows()
    plot_comparison(panels, path)


def draw_maps(study: Comparison, runs: dict[tuple[str, str], Batches], path: Path) -> None:
    """Where virtual goals lie: a row for each task, q of each algorithm, and q* at the right."""
    tasks = [task for task in study.tasks if any(task == own for own, _ in runs)]
    names = [name for name in study.algorithms if any(name == own for _, own in runs)]
    figure = Figure(figsize=(3 * (len(names) + 1), 3.1 * len(tasks)), layout="constrained")
    for line, task in zip(figure.subplots(len(tasks), len(names) + 1, squeeze=False), tasks, strict=True):
        env, target = make_env(task), None
        env.reset()
        for axes, name in zip(line, names, strict=False):
            own = runs.get((task, name))
            axes.set_axis_off()
            if own is not None and (goals := own.goal_map()) is not None:
                target = goals.target
                axes.set_axis_on()
                draw_goals(axes, goals.share, env, limit=float(target.max()))
                axes.set_title(f"{task}, {name}", fontsize=9)
        if target is not None:
            draw_goals(line[-1], target, env, limit=float(target.max()))
            line[-1].set_title("target q*", fontsize=9)
    figure.savefig(path, dpi=80)


def write_data(study: str, runs: dict[tuple[str, str], Batches]) -> None:
    for (task, algorithm), own in runs.items():
        rows = own.rows()
        columns = [name for name in COLUMNS if name in rows[-1]]
        stem = "_".join(dict.fromkeys((study, task, algorithm)))  # options have the study's name for the last
        with open(HERE / "results" / f"{stem}.csv", "w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(columns)
            for row in rows:
                writer.writerow(f"{row.get(name, float('nan')):.5g}" for name in columns)


def make_options(name: str, folder: Path) -> None:
    """The same for a study of one option: one panel, a curve for each value."""
    study = load_study(name)
    runs = {(label, study.name): Batches(folder / label) for label, _ in study.cells()}
    if all(own.is_done for own in runs.values()):
        print(f"\n### {name}\n")
        print_table(runs, "option | study")
        shutil.copy(draw_study(study, folder), HERE / "images" / f"{name}.png")
        write_data(name, runs)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", type=Path, help="folder that the studies lie in")
    folder = parser.parse_args().runs
    for name, study in COMPARISONS.items():
        runs = read_study(study, folder / name)
        if runs:
            print(f"\n### {name}\n")
            print_table(runs)
            draw_success(runs, HERE / "images" / f"{name}.png")
            write_data(name, runs)
            if study.goals:
                draw_maps(study, runs, HERE / "images" / f"{name}_goals.png")
    for name in OPTIONS:
        make_options(name, folder / name)


if __name__ == "__main__":
    main()
