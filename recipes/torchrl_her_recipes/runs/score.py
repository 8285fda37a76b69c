"""One number that says how good a run was: what searches maximize."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from pathlib import Path

from torchrl_her_recipes.components.assembly import build
from torchrl_her_recipes.config.recipe import Recipe
from torchrl_her_recipes.runs.callbacks import Callback
from torchrl_her_recipes.runs.run import run

LAST = 5  # evaluations


def score(rows: Sequence[dict[str, float]], *, last: int = LAST) -> float:
    """The median over the runs of their mean success in the last evaluations.

    Args:
        rows: the table of metrics, with a row for each epoch and run.
        last: how many evaluations; all, as long as there are fewer.

    Returns:
        From 0 to 1; 0 if there was no evaluation.

    Raises:
        ValueError: ``last`` is below 1.

    Example:
        >>> good = [{"run": 0, "epoch": 1, "success": 0.5}, {"run": 0, "epoch": 2, "success": 1.0}]
        >>> bad = [{"run": 1, "epoch": 1, "success": 0.0}, {"run": 1, "epoch": 2, "success": 0.5}]
        >>> score(good), score(good + bad), score(good + bad, last=1)
        (0.75, 0.5, 0.75)
    """
    if last < 1:
        raise ValueError(f"last must be at least 1, got {last}")
    counted = sorted({row["epoch"] for row in rows})[-last:]
    successes: dict[float, list[float]] = {}
    for row in rows:
        if row["epoch"] in counted:
            successes.setdefault(row["run"], []).append(row["success"])
    return statistics.median(map(statistics.fmean, successes.values())) if successes else 0.0


def run_score(
    recipe: Recipe,
    folder: str | Path | None = None,
    *,
    callbacks: Sequence[Callback] = (),
    progress: bool = False,
) -> float:
    """Trains, and returns the score of the result: what any program that searches can maximize.

    Args:
        recipe: its ``num_runs`` runs, side by side, are the seeds that the score is the median of.
        folder: where the run writes its files; None writes nothing.
        callbacks: called on the way; they may stop the run.
        progress: whether to show a progress bar, or a line for each epoch where there is no terminal.

    Raises:
        ValueError: the folder holds a run already.
        KeyboardInterrupt: by Ctrl-C; with a folder, what there is was saved in it.
    """
    result = run(build(recipe), folder, callbacks=callbacks, progress=progress)
    if result.interrupted:
        raise KeyboardInterrupt  # a search that goes on would take an unfinished run for a bad one
    return score(result.rows)
