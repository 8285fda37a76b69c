"""Makes the numbers, tables and pictures of RESULTS.md from finished runs.

    python docs/make_results.py runs    # reads runs/STUDY, writes results/STUDY first
    python docs/make_results.py         # tables and pictures of the numbers that are in results/

For every study that there is, it prints a table and draws ``docs/images/STUDY.png``; for those of
virtual goals, if their histograms are there, also ``docs/images/STUDY_goals.png``, and for those of the
thesis ``docs/images/STUDY_thesis.png``, the metrics of its other figures as far as they are stored. The
pages of the studies are made by ``make docs``.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from torchrl_her_envs import make_env
from torchrl_her_recipes.config.study import load_study
from torchrl_her_recipes.reports.results import Combination
from torchrl_her_recipes.reports.tidy import is_results, read_results, write_results
from torchrl_her_recipes.runs.plots import draw_goals, plot_comparison
from torchrl_her_recipes.runs.scores import LAST, at_the_end

HERE = Path(__file__).parent
RESULTS = HERE.parent / "results"
STUDIES = {  # where they are described: in the package, or in a file beside this script
    "v0": str(HERE / "studies" / "v0.yaml"),
    "ibs": "ibs",
    "ibs_before": "ibs",
    "bias": "bias",
    "bias_before": "bias",
    "floor": str(HERE / "studies" / "floor.yaml"),
    "thesis_v1": str(HERE / "studies" / "thesis_v1.yaml"),
    "curriculum": "curriculum",
    "climb": str(HERE / "studies" / "climb.yaml"),
    "cher": str(HERE / "studies" / "cher.yaml"),
    "draws": str(HERE / "studies" / "draws.yaml"),
    "thesis_agent": str(HERE / "studies" / "thesis_agent.yaml"),
    "learners": str(HERE / "studies" / "learners.yaml"),
    "n_steps": "n_steps",
    "search": str(HERE / "studies" / "search.yaml"),
    "filter_bias": "filter_bias",
    "refused": str(HERE / "studies" / "refused.yaml"),
    "divergence": "divergence",
    "wall": "wall",
    "proposals": "proposals",
    "demonstrations": str(HERE / "studies" / "demonstrations.yaml"),
    "demonstrations_preset": str(HERE / "studies" / "demonstrations_preset.yaml"),
    "fetch_ablation": str(HERE / "studies" / "fetch_ablation.yaml"),
    "defaults": "defaults",
    "window": "window",
    "initialisation": "initialisation",
    "bit_flip": "bit_flip",
    "chain": "chain",
    "treasure_hunt": "treasure_hunt",
    "useless_action": "useless_action",
}
TOYS = ("chain", "treasure_hunt", "useless_action")  # make_chain_times.py and make_toy_values.py draw these
MAPS = ("ibs", "bias")  # studies whose maps of virtual goals are drawn
POSITIVE = ("rows_real_positive", "rows_virtual_positive", "rows_useful_virtual_positive")
THESIS = {  # metrics of the thesis's figures beside success
    "ibs": ("distance",),
    "bias": ("distance", "q", "q_bias"),
    "bias_before": ("q_bias",),
    "filter_bias": ("distance", "q"),
    "curriculum": ("distance", *POSITIVE),
}

Rows = list[dict[str, float]]


def export(runs: Path) -> None:
    """Writes the numbers of the studies that have runs in a folder."""
    for name, described in STUDIES.items():
        if (runs / name).is_dir():
            command = f"torchrl-her study {described if described == name else f'docs/studies/{name}.yaml'}"
            if name in ("treasure_hunt", "useless_action"):
                command = f"python docs/make_toy_values.py --study {name}"
            write_results(load_study(described), runs / name, RESULTS / name, command=command)


def spread(values: Sequence[float], form: str) -> str:
    """The median, and the 33rd to 67th percentile."""
    low, middle, high = np.percentile(values, [33, 50, 67])
    return f"**{middle:{form}}** ({low:{form}} to {high:{form}})"


def entries(cell: Combination) -> list[str]:
    """A combination's row of the table, without task and algorithm."""
    success, counted = at_the_end(cell.rows, "success"), "kl" in cell.rows[0]  # are goals counted?
    kl = spread(at_the_end(cell.rows, "kl", evaluations=1), ".2f") if counted else ""
    return [str(cell.runs), f"{cell.frames:,}", spread(success, ".0%"), f"{min(success):.0%}", kl]


def print_table(cells: Sequence[Combination]) -> None:
    print("| task | algorithm | runs | frames | success at the end | worst run | KL(q, q*) |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for cell in cells:
        print(f"| {' | '.join([f'`{cell.task}`', f'`{cell.algorithm}`', *entries(cell)])} |")


def frames_until(rows: Rows, success: float) -> list[float]:
    """Frames of each run until the mean of its last evaluations has come to a success; inf if it has not."""
    frames = []
    for run in sorted({row["run"] for row in rows}):
        own = [row for row in rows if row["run"] == run]
        means = [
            np.mean([row["success"] for row in own[end - LAST : end]]) for end in range(LAST, len(own) + 1)
        ]
        there = np.flatnonzero(np.array(means) >= success - 1e-6)
        frames.append(own[there[0] + LAST - 1]["frames"] if len(there) else np.inf)
    return frames


def print_speed(cells: Sequence[Combination], success: float) -> None:
    print(f"\n| combination | frames until {success:.0%} | runs that never are |")
    print("| --- | --- | --- |")
    for cell in cells:
        frames = frames_until(cell.rows, success)
        low, middle, high = np.percentile(np.minimum(frames, cell.frames), [33, 50, 67])  # at the end at most
        never = int(np.isinf(frames).sum())
        print(f"| `{cell.algorithm}` | **{middle:,.0f}** ({low:,.0f} to {high:,.0f}) | {never} |")


def print_from_change(cells: Sequence[Combination], every: Sequence[int], within: int) -> None:
    """Success some frames after a run has come to the full task, where the thesis's curves of windows begin.

    Args:
        cells: combinations of runs in two stages.
        every: numbers of frames since then.
        within: frames whose evaluations count, up to each of these.
    """
    columns = " | ".join(f"{frames:,} frames later" for frames in every)
    print(f"\n| combination | first stage, frames | {columns} |")
    print(f"| --- | --- |{' --- |' * len(every)}")
    for cell in cells:
        changes, later = [], []
        for run in sorted({row["run"] for row in cell.rows}):
            rows = [row for row in cell.rows if row["run"] == run]
            changes.append(next(row["frames"] for row in rows if row["stage"] > 0))
            since = [(row["frames"] - changes[-1], row["success"]) for row in rows]
            later.append(
                [np.mean([own for frames, own in since if end - within < frames <= end]) for end in every]
            )
        shown = [spread(column, ".0%") for column in zip(*later, strict=True)]
        print(f"| `{cell.algorithm}` | {' | '.join([spread(changes, ',.0f'), *shown])} |")


def draw_study(cells: Sequence[Combination], metrics: Sequence[str], path: Path) -> None:
    """Metrics of a study over environment steps."""
    panels: dict[str, dict[str, Rows]] = {}
    for cell in cells:
        panels.setdefault(cell.task, {})[cell.algorithm] = cell.rows
    plot_comparison(panels, path, metrics=metrics)


def draw_the_ends(cells: Sequence[Combination], measure: str, label: str, path: Path) -> None:
    """A line for each combination: median and 33rd to 67th percentile of its runs at the end."""
    ends = [at_the_end(cell.rows, measure, evaluations=1) for cell in cells]
    low, middle, high = np.percentile(ends, [33, 50, 67], axis=1)
    figure = Figure(figsize=(7.0, 0.8 + 0.27 * len(cells)), layout="constrained")
    axes, lines = figure.subplots(), range(len(cells))
    axes.errorbar(middle, lines, xerr=(middle - low, high - middle), fmt="o", color="#2b6cb0", capsize=3)
    axes.set_yticks(lines, [cell.algorithm for cell in cells])
    axes.invert_yaxis()
    axes.grid(alpha=0.3)
    axes.set(xlabel=label, xlim=(0.0, None))
    figure.savefig(path, dpi=110)


def draw_demonstrations(cells: Sequence[Combination], path: Path) -> None:
    """Success at the end over the number of demonstrations, and the curriculum in their place."""
    ends = {cell.algorithm: np.percentile(at_the_end(cell.rows, "success"), [33, 50, 67]) for cell in cells}
    numbers = ["0", "1", "10", "100"]
    figure = Figure(figsize=(5.2, 3.8), layout="constrained")
    axes, places = figure.subplots(), range(len(numbers))
    for how, label, color in (("rows", "rows", "#2b6cb0"), ("cloned", "rows and cloning", "#38a169")):
        own = [ends["none"] if number == "0" else ends[f"{number}_{how}"] for number in numbers]
        low, middle, high = np.stack(own, 1)
        axes.errorbar(
            places, middle, (middle - low, high - middle), marker="o", capsize=3, color=color, label=label
        )
    low, middle, high = ends["curriculum"]
    axes.axhline(middle, color="#dd6b20", label="a curriculum in their place")
    axes.axhspan(low, high, color="#dd6b20", alpha=0.2, linewidth=0)
    axes.set_xticks(places, numbers)
    axes.set(xlabel="demonstrations", ylabel="success rate at the end", ylim=(0.0, 1.0))
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    figure.savefig(path, dpi=110)


def draw_maps(cells: Sequence[Combination], path: Path) -> None:
    """Where virtual goals lie: a row for each task, q of each algorithm, and q* at the right."""
    tasks = list(dict.fromkeys(cell.task for cell in cells))
    names = list(dict.fromkeys(cell.algorithm for cell in cells))
    found = {(cell.task, cell.algorithm): cell.goals for cell in cells}
    figure = Figure(figsize=(3 * (len(names) + 1), 3.1 * len(tasks)), layout="constrained")
    for line, task in zip(figure.subplots(len(tasks), len(names) + 1, squeeze=False), tasks, strict=True):
        env, target = make_env(task), None
        env.reset()
        for axes, name in zip(line, names, strict=False):
            axes.set_axis_off()
            if (goals := found.get((task, name))) is not None:
                target = goals.target
                axes.set_axis_on()
                draw_goals(axes, goals.share, env, limit=float(target.max()))
                axes.set_title(f"{task}, {name}", fontsize=9)
        if target is not None:
            draw_goals(line[-1], target, env, limit=float(target.max()))
            line[-1].set_title("target q*", fontsize=9)
    figure.savefig(path, dpi=80)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", type=Path, nargs="?", help="folder with a folder of runs for each study")
    parser.add_argument("--images", type=Path, default=HERE / "images", help="where the pictures go")
    options = parser.parse_args()
    if options.runs is not None:
        export(options.runs)
    for name in STUDIES:
        if is_results(RESULTS / name):
            every = read_results(RESULTS / name).cells
            cells = [cell for cell in every if cell.done] or every
            print(f"\n### {name}\n")
            print_table(cells)
            if name == "wall":
                print_speed(cells, 0.8)
            if name == "window":
                print_from_change(cells, (25_600, 51_200, 76_800, 102_400, 126_720), within=6_400)
            if name == "divergence":
                draw_the_ends(cells, "kl", "KL(q, q*)", options.images / f"{name}.png")
            elif name in TOYS:
                continue
            elif name == "demonstrations":
                draw_demonstrations(cells, options.images / f"{name}.png")
            else:
                draw_study(cells, load_study(STUDIES[name]).figure, options.images / f"{name}.png")
            stored = [metric for metric in THESIS.get(name, ()) if all(cell.has(metric) for cell in cells)]
            if stored:
                draw_study(cells, stored, options.images / f"{name}_thesis.png")
            if name in MAPS and any(cell.goals is not None for cell in cells):
                draw_maps(cells, options.images / f"{name}_goals.png")


if __name__ == "__main__":
    main()
