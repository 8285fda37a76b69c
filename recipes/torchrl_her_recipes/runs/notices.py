"""Detects typical problems of training in the table of metrics, and suggests options that help."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial

from torch import Tensor

from torchrl_her_recipes.config.algorithms import Algorithm
from torchrl_her_recipes.config.choices.learners import LearnerConfig
from torchrl_her_recipes.config.recipe import Recipe

Row = dict[str, float]  # row of the table of metrics: one epoch of one run

_AT_BOUND = 0.99  # an action beyond this fraction of its range, counted from the middle, is at its bound
_NEARLY_ALL = 0.95  # fraction of the entries of all actions, or of virtual rows, that counts as nearly all
_STREAK = 3  # epochs in a row that show a problem before it is reported
_LONG = 5  # epochs in a row for problems that may pass by themselves
_LITTLE = 0.5  # success rate below which there is a problem; above it, actions at their bounds may be right
_FEW = 0.02  # fraction of the transitions that counts as few
_BEYOND = 0.25  # fraction of the range of returns by which values must exceed the range to be reported


def saturation(action: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Computes the fraction of each action's entries that are at their bounds.

    Args:
        action: [..., a].
        low: [a], the least action; an entry never counts as being at an infinite bound.
        high: [a], the greatest action.

    Returns:
        Fractions from 0 to 1, [...].

    Example:
        >>> import torch
        >>> high = torch.tensor([1.0, 2.0])
        >>> saturation(torch.tensor([[1.0, 0.0], [-0.995, 2.0]]), -high, high)
        tensor([0.5000, 1.0000])
    """
    middle, half = (high + low) / 2, (high - low) / 2
    bounded = half.isfinite()
    return (((action - middle).abs() >= _AT_BOUND * half) & bounded).float().mean(-1)


def notices(rows: Sequence[Row], recipe: Recipe, bounds: tuple[float, float]) -> list[str]:
    """Returns a message for each problem that appears for the first time in the newest epoch.

    Args:
        rows: the table of metrics so far, one row for each epoch and run.
        recipe: recipe of the runs.
        bounds: the least and the greatest reward; infinite if rewards have no bounds.
    """
    runs: dict[float, list[Row]] = {}
    for row in rows:
        runs.setdefault(row["run"], []).append(row)
    task, learner = recipe.task.name, recipe.learner
    rules = [  # each takes the rows of a run, and returns a message if they show its problem
        partial(_no_update, recipe),
        partial(_nothing_achieved, task),
        partial(_nothing_to_relabel, task, recipe.hindsight.algorithm),
        partial(_saturated, learner),
        partial(_beyond, learner, bounds),
        partial(_fallen, learner),
    ]
    lines = [
        f"seed {run[-1]['seed']:.0f}: {notice}"
        for run in runs.values()
        for rule in rules
        if (notice := rule(run)) and not any(rule(run[:end]) for end in range(1, len(run)))
    ]
    every = list(runs.values())
    if _differ(every) and not any(
        _differ([run[:end] for run in every]) for end in range(_LONG, len(every[0]))
    ):
        lines.append(_DIFFER)
    return lines


def _success(row: Row) -> float:
    return row.get("stage_success", row["success"])  # in a curriculum, success at the current stage's goals


def _no_update(recipe: Recipe, rows: Sequence[Row]) -> str | None:
    row = rows[-1]
    if row.get("updates", 1) or row["epoch"] < recipe.run.epochs:  # the last epoch may end after the warm-up
        return None
    return (
        f"the run ends after {row['frames']:,.0f} environment steps, before its first gradient step. What "
        f"helps: warmup_frames below {recipe.collection.warmup_frames:,}, or more frames"
    )


def _nothing_achieved(task: str, rows: Sequence[Row]) -> str | None:
    if len(rows) < _LONG or rows[-1].get("rows_real_positive", 1) or any(map(_success, rows)):
        return None
    return (
        f"no goal has been achieved in {rows[-1]['frames']:,.0f} environment steps. What helps: "
        "a curriculum (algo=cher), goals within reach (behavior=uniform_achieved) or demonstrations; "
        f"`torchrl-her check task={task}` looks for the cause"
    )


def _nothing_to_relabel(task: str, algorithm: Algorithm, rows: Sequence[Row]) -> str | None:
    row = rows[-1]
    if len(rows) < _STREAK or _success(row) >= _LITTLE or "rows_virtual" not in row or not algorithm.virtual:
        return None
    if row["rows_virtual_positive"] > _NEARLY_ALL * row["rows_virtual"] > 0:
        return (
            f"{row['rows_virtual_positive'] / row['rows_virtual']:.0%} of the virtual goals were achieved "
            "before the action: nothing can be learned from them. What helps: the filter "
            "(algo=filtered_her), a curriculum (algo=cher) or demonstrations"
        )
    if algorithm.filter and row["rows_relabeled"] <= _FEW * row["rows_real"]:
        return (
            f"the filter has left {row['rows_relabeled']:,.0f} of {row['rows_real']:,.0f} transitions with "
            "goals of their own episode: the achieved goal hardly changes. What helps: a curriculum "
            "(algo=cher), longer episodes (task.options.max_steps) or demonstrations; "
            f"`torchrl-her check task={task}` looks for the cause"
        )
    return None


def _saturated(learner: LearnerConfig, rows: Sequence[Row]) -> str | None:
    """Reports actions at their bounds, where an actor that ends in tanh has almost no gradient."""
    last = rows[-_STREAK:]
    stuck = [row.get("saturation", 0.0) >= _NEARLY_ALL and _success(row) < _LITTLE for row in last]
    if len(last) < _STREAK or not all(stuck):
        return None
    helps = [f"learning_rate below {learner.learning_rate:g}", "a larger batch_size"]
    if (penalty := getattr(learner, "saturation_penalty", None)) is not None:
        helps.insert(0, f"saturation_penalty above {penalty:g}")
    return (
        f"nearly all greedy actions have been at their bounds for {_STREAK} epochs (now "
        f"{last[-1]['saturation']:.0%}), with {_success(last[-1]):.0%} success; the actor may have stopped "
        f"learning. What helps: {' or '.join(helps)}"
    )


def _beyond(learner: LearnerConfig, bounds: tuple[float, float], rows: Sequence[Row]) -> str | None:
    """Reports critics whose values of starts are outside of the range of possible returns."""
    gamma = float(learner.gamma)
    horizon = 1 / (1 - gamma) if gamma < 1 else math.inf
    low, high = min(0.0, horizon * bounds[0]), max(0.0, horizon * bounds[1])
    margin = _BEYOND * (high - low)
    last = rows[-_STREAK:]
    outside = [not low - margin <= row.get("q", low) <= high + margin for row in last]
    if math.isinf(margin) or len(last) < _STREAK or not all(outside):
        return None
    helps = [f"tau below {learner.tau:g}", f"learning_rate below {learner.learning_rate:g}"]
    if not getattr(learner, "clamp_targets", True):
        helps.insert(0, "clamp_targets=true")
    return (
        f"the critic gives starts a mean value of {last[-1]['q']:.4g}, but returns are between {low:.4g} and "
        f"{high:.4g}: the critic diverges. What helps: {' or '.join(helps)}"
    )


def _fallen(learner: LearnerConfig, rows: Sequence[Row]) -> str | None:
    means = _means([row["success"] for row in rows])
    stages = {row.get("stage", 0.0) for row in rows[-2 * _STREAK :]}
    if len(means) <= _STREAK or len(stages) > 1 or max(means) < _LITTLE or means[-1] > max(means) / 2:
        return None
    helps = [f"learning_rate below {learner.learning_rate:g}"]
    if learner.norm != "layer":
        helps.insert(0, "norm=layer")
    if not getattr(learner, "ema_decay", 1.0):
        helps.insert(0, "ema_decay=0.999")
    return (
        f"success was {max(means):.0%} and has fallen to {means[-1]:.0%}; best.safetensors has the best "
        f"policy. What helps: {' or '.join(helps)}"
    )


_DIFFER = (
    f"the runs have differed by more than half in success for {_LONG} epochs: report the worst run, too. "
    "What helps: more gradient steps (a lower frames_per_update), ema_decay=0.999 or, in a curriculum, "
    "guided_share=0.5"
)


def _differ(runs: Sequence[Sequence[Row]]) -> bool:
    last = [[row["success"] for row in run[-_LONG:]] for run in runs]
    full = min(map(len, last)) == _LONG
    return full and all(max(epoch) - min(epoch) > _LITTLE for epoch in zip(*last, strict=True))


def _means(values: Sequence[float]) -> list[float]:
    """Computes the moving average of values over ``_STREAK`` epochs."""
    return [sum(values[end - _STREAK : end]) / _STREAK for end in range(_STREAK, len(values) + 1)]
