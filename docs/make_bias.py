"""Makes the table and the picture of RESULTS.md on the filter and the bias of Q.

    python docs/make_bias.py    # of the numbers in results/filter_bias

The bias is the value of an episode's first state minus the return of the greedy policy from there. A policy
that fails gets the least return, so the bias falls as success rises, whatever the cause. The table has the
difference that the filter makes to both, and what is left of that of the bias at equal success: the
coefficient of the filter in a linear regression of the bias on success and filter, over the runs of a
combination with and without it. Intervals are of 95 %, by bootstrap over the runs.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from torchrl_her_recipes.reports.tidy import read_results
from torchrl_her_recipes.runs.plots import COLORS

HERE = Path(__file__).parent
FIRST = 4  # the epoch from which on the means are taken: before it, Q is still on its way from 0
GOALS = {"real": ("success", "q_bias"), "virtual": ("virtual_success", "virtual_q_bias")}
CASES = {"as_it_is": "o", "no_penalty": "s", "neither": "^"}

Means = dict[str, np.ndarray]  # of each run, by metric
Statistic = Callable[[Means, Means], float]


def means(rows: list[dict[str, float]]) -> Means:
    """The mean of each metric over the epochs of each run."""
    runs = sorted({row["run"] for row in rows})
    chosen = [[row for row in rows if row["run"] == run and row["epoch"] >= FIRST] for run in runs]
    names = [name for pair in GOALS.values() for name in pair]
    return {name: np.array([np.mean([row[name] for row in own]) for own in chosen]) for name in names}


def difference(name: str) -> Statistic:
    """That of the means of a metric, with the filter minus without."""
    return lambda without, filtered: float(filtered[name].mean() - without[name].mean())


def at_equal_success(success: str, bias: str) -> Statistic:
    """The coefficient of the filter in a regression of the bias on success and filter."""

    def coefficient(without: Means, filtered: Means) -> float:
        x, y = (np.concatenate([without[name], filtered[name]]) for name in (success, bias))
        with_filter = np.repeat([0.0, 1.0], [len(without[bias]), len(filtered[bias])])
        columns = np.stack([np.ones_like(x), x, with_filter], axis=1)
        return float(np.linalg.lstsq(columns, y, rcond=None)[0][2])

    return coefficient


def with_interval(statistic: Statistic, without: Means, filtered: Means, *, scale: float = 1.0) -> str:
    """A statistic of the runs, and its interval."""
    draw = np.random.default_rng(0)

    def again(own: Means) -> Means:
        chosen = draw.integers(0, len(own["q_bias"]), len(own["q_bias"]))
        return {name: values[chosen] for name, values in own.items()}

    low, high = np.percentile([statistic(again(without), again(filtered)) for _ in range(2000)], [2.5, 97.5])
    form = ".0f" if scale > 1 else ".1f"
    middle = f"{scale * statistic(without, filtered):+{form}}"
    shown = f"**{middle}**" if low * high > 0 else middle  # 0 is outside
    return f"{shown} ({scale * low:+{form}} to {scale * high:+{form}})"


def main() -> None:
    found: dict[tuple[str, str, str], Means] = {}  # by task, algorithm and case
    for cell in read_results(HERE.parent / "results" / "filter_bias").cells:
        case = next(case for case in CASES if cell.algorithm.endswith(case))
        found[cell.task, cell.algorithm.removesuffix(f"_{case}"), case] = means(cell.rows)
    names = ["task", "agent", "success, points"]
    for kind in GOALS:
        names += [f"bias, {kind} goals", "at equal success"]
    print(f"| {' | '.join(names)} |\n|{' --- |' * len(names)}")
    tasks = list(dict.fromkeys(task for task, _, _ in found))
    for task in tasks:
        for case in CASES:
            both = found[task, "her", case], found[task, "filtered_her", case]
            columns = [with_interval(difference("success"), *both, scale=100.0)]
            for success, bias in GOALS.values():
                columns.append(with_interval(difference(bias), *both))
                columns.append(with_interval(at_equal_success(success, bias), *both))
            print(f"| `{task}` | `{case}` | {' | '.join(columns)} |")
    figure = Figure(figsize=(3.6 * len(tasks), 6.6), layout="constrained")
    for line, (kind, (success, bias)) in zip(figure.subplots(2, len(tasks)), GOALS.items(), strict=True):
        for axes, task in zip(line, tasks, strict=True):
            for algorithm in ("her", "filtered_her"):
                for case, marker in CASES.items():
                    own = found[task, algorithm, case]
                    label = f"{algorithm}, {case}"
                    axes.scatter(
                        own[success], own[bias], s=16, marker=marker, color=COLORS[algorithm], label=label
                    )
            axes.set(title=f"{task}, {kind} goals", xlabel="success", ylabel="bias of Q")
            axes.grid(alpha=0.3)
    axes.legend(fontsize=7)
    figure.savefig(HERE / "images" / "filter_bias_success.png", dpi=90)


if __name__ == "__main__":
    main()
