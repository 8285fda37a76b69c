"""Draws how long chains took to be solved, beside the ideal learners of the thesis's appendix C.

torchrl-her study chain --folder runs/chain
python docs/make_chain_times.py runs/chain/*/    # draws docs/images/chain.png
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from torchrl_her_recipes.config.algorithms import get_algorithm
from torchrl_her_recipes.config.recipe import Recipe
from torchrl_her_recipes.runs.plots import COLORS, Rows, save_figure
from torchrl_her_recipes.studies.seed_batches import Batches

_RANDOM = 0.5  # p of the thesis: one of two actions goes forward
_SOLVED = 0.9  # success of the greedy policy


def learning_steps(length: int, stages: int, algo: str) -> list[int]:
    """The stretches of a chain that an ideal learner has to walk at random without a mistake.

    Without hindsight that is all of it; with hindsight, all up to the first link that counts as achieved,
    and then link by link; up a curriculum link by link from the start.

    Args:
        length: n, the number of steps to the goal.
        stages: parts of the chain, of which only the last is achieved.
        algo: name of an algorithm.

    Returns:
        Lengths that sum up to n.

    Example:
        >>> [learning_steps(6, 3, algo) for algo in ("no_hindsight", "her", "cher")]
        [[6], [5, 1], [1, 1, 1, 1, 1, 1]]
    """
    algorithm = get_algorithm(algo)
    if not algorithm.virtual:
        return [length]
    hidden = 0 if algorithm.curriculum else length - length // stages
    return [hidden + 1] + [1] * (length - hidden - 1)


def ideal_episodes(stretches: Iterable[int], p: float) -> float:
    """Episodes that an ideal learner of appendix C takes on average.

    It goes to the best place that it knows a way to (premise 2), then goes on at random, forward with
    probability p (premise 1), until its first mistake, which ends the episode (premise 4); one example
    is enough to know a way (premise 3). So there is one episode that arrives, and a stretch of length g
    costs ``p ** -g - 1`` failures before. A single stretch is ``p ** -n`` as in the thesis; n of length 1
    are ``1 + n (1 / p - 1)``, where the thesis counts n / p attempts, of which n succeed.

    Example:
        >>> ideal_episodes([6], 0.5), ideal_episodes([1] * 6, 0.5)
        (64.0, 7.0)
    """
    return 1.0 + sum(p**-stretch - 1.0 for stretch in stretches)


def episodes_to_solve(rows: Rows, length: int) -> list[float]:
    """Episodes of each run up to the first evaluation at which it solves the chain; infinite if none.

    Args:
        rows: the table of metrics, one row an epoch and run.
        length: steps of an episode.

    Example:
        >>> rows = [{"run": 0, "frames": 60 * n, "success": n > 1} for n in (1, 2, 3)]
        >>> episodes_to_solve(rows, 6)
        [20.0]
    """
    first: dict[float, float] = {}
    for row in rows:
        solved = row["frames"] / length if row["success"] >= _SOLVED else math.inf
        first[row["run"]] = min(first.get(row["run"], math.inf), solved)
    return list(first.values())


def plot_times(runs: Sequence[tuple[Recipe, Rows]], path: Path) -> None:
    """Draws episodes until the chain is solved over its length, beside appendix C's ideal learners.

    Marks are medians of runs with the 33rd to 67th percentile; open ones lie at the end of runs most of
    which did not solve it.

    Args:
        runs: recipes and their tables of metrics.
        path: of the picture.

    Raises:
        ValueError: runs of another task, or of chains of different numbers of stages.
    """
    tasks = {recipe.task.name for recipe, _ in runs}
    if tasks != {"chain"}:
        raise ValueError(f"times are drawn of runs of chain, got {sorted(tasks)}")
    stages = {_option(recipe, "stages", 1) for recipe, _ in runs}
    if len(stages) != 1:
        raise ValueError(f"times are drawn of chains of one number of stages, got {sorted(stages)}")
    figure = Figure(figsize=(7.0, 4.6), layout="constrained")
    axes = figure.subplots()
    by_algo: dict[str, dict[int, tuple[Recipe, Rows]]] = {}
    for recipe, rows in runs:
        by_algo.setdefault(recipe.hindsight.algo, {})[_option(recipe, "length", 10)] = recipe, rows
    lengths = sorted({length for cells in by_algo.values() for length in cells})
    (parts,) = stages
    _draw_theory(axes, lengths)
    drawn: list[list[float]] = []  # the filter makes no difference to an ideal learner
    for index, (algo, cells) in enumerate(by_algo.items()):
        ideal = [ideal_episodes(learning_steps(n, parts, algo), _RANDOM) for n in lengths]
        if ideal not in drawn:
            axes.plot(lengths, ideal, color=COLORS[algo], linewidth=1.2, label=f"{algo}, ideal")
            drawn.append(ideal)
        _draw_measured(axes, algo, cells, shift=0.12 * (index - (len(by_algo) - 1) / 2))
    axes.set_yscale("log")
    axes.set(
        xticks=lengths,
        xlabel=f"steps n of the chain, in {parts} parts",
        ylabel="episodes until it is solved",
    )
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    save_figure(figure, path)


def _option(recipe: Recipe, name: str, default: int) -> int:
    return int((recipe.task.options or {}).get(name, default))


def _draw_theory(axes: Axes, lengths: Sequence[int]) -> None:
    n = np.linspace(lengths[0], lengths[-1], 50)
    axes.plot(n, (1 / _RANDOM) ** n, "k:", label="$(1/p)^n$")
    axes.plot(n, n / _RANDOM, "k--", label="$n/p$")


def _draw_measured(axes: Axes, algo: str, cells: Mapping[int, tuple[Recipe, Rows]], *, shift: float) -> None:
    color = COLORS[algo]
    label: str | None = f"{algo}, DQN"
    for length, (recipe, rows) in sorted(cells.items()):
        end = recipe.total_frames / length
        times = np.minimum(episodes_to_solve(rows, length), 2 * end)
        low, middle, high = np.percentile(times, [33, 50, 67], method="nearest")
        solved = middle <= end
        axes.errorbar(
            length + shift,
            min(middle, end),
            yerr=[[min(middle, end) - min(low, end)], [min(high, end) - min(middle, end)]],
            fmt="o" if solved else "^",
            color=color,
            markerfacecolor=color if solved else "white",
            capsize=3,
            label=label,
        )
        label = None


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", nargs="+", type=Path, help="folders of the study's combinations")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "images" / "chain.png")
    options = parser.parse_args()
    runs = [Batches(folder) for folder in options.runs]
    plot_times([(own.homes[0].recipe(), own.rows()) for own in runs], options.out)


if __name__ == "__main__":
    main()
