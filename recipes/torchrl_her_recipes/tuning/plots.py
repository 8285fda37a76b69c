"""Pictures of a search: its history, what its options did, and which of them matter."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import accumulate
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter, PercentFormatter, StrMethodFormatter

from torchrl_her_recipes.config.spaces import Entry, Space
from torchrl_her_recipes.runs.plots import COLORS, save_figure
from torchrl_her_recipes.tuning.standing import TrialRow

_MANY_TRIALS = 20
_COLOR, _PALE = COLORS["filtered_her_ibs"], COLORS["her_ibs_sequential"]


def plot_history(trials: Sequence[TrialRow], path: Path) -> None:
    """Draws the score of each trial, and the best one so far.

    Args:
        trials: by their numbers.
        path: of the picture.
    """
    figure = Figure(figsize=(7.0, 4.2), layout="constrained")
    axes = figure.subplots()
    axes.set_title("scores of the trials")
    done, pruned = _of(trials, "complete"), _of(trials, "pruned")
    _scatter(axes, [trial.number for trial in done], done, [trial.number for trial in pruned], pruned)
    best = list(accumulate((trial.score or 0.0 for trial in done), max))
    axes.step([trial.number for trial in done], best, where="post", color=COLORS["her"], label="best so far")
    axes.set(xlabel="trial", ylabel="score", ylim=(-0.03, 1.03))
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    _percent(axes)
    axes.legend(fontsize=8)
    save_figure(figure, path)


def plot_importance(importance: Mapping[str, float], path: Path, *, trials: int) -> None:
    """Draws how much each option matters.

    Args:
        importance: as a share of 1, the largest first.
        path: of the picture.
        trials: that it was found from; few of them only let one guess.
    """
    figure = Figure(figsize=(7.0, 1.2 + 0.32 * len(importance)), layout="constrained")
    axes = figure.subplots()
    guess = f" (a guess, from {trials} trials)" if trials < _MANY_TRIALS else ""
    axes.set_title(f"how much each option decides about good trials{guess}")
    bars = axes.barh(list(importance), list(importance.values()), color=_COLOR)
    axes.bar_label(bars, fmt="{:.0%}", padding=3, fontsize=8)
    axes.invert_yaxis()
    axes.set(xlim=(0, max(importance.values()) * 1.12 or 1), xlabel="importance (PED-ANOVA)")
    axes.xaxis.set_major_formatter(PercentFormatter(1.0))
    axes.grid(axis="x", alpha=0.3)
    save_figure(figure, path)


def plot_options(trials: Sequence[TrialRow], space: Space, path: Path) -> None:
    """Draws the score over each option, a panel each.

    Args:
        trials: of the search.
        space: its options.
        path: of the picture.
    """
    entries = list(space)
    columns = min(4, len(entries))
    rows = -(-len(entries) // columns)
    figure = Figure(figsize=(1.0 + 2.9 * columns, 0.6 + 2.3 * rows), layout="constrained")
    figure.suptitle("scores over the options (open circles: pruned)")
    grid = figure.subplots(rows, columns, sharey=True, squeeze=False)
    for axes, entry in zip(grid.flat, entries, strict=False):
        done, pruned = (
            [trial for trial in _of(trials, state) if entry.name in trial.values]
            for state in ("complete", "pruned")
        )
        _scatter(axes, _places(entry, done), done, _places(entry, pruned), pruned)
        axes.set(xlabel=entry.name, ylim=(-0.03, 1.03))
        _scale(axes, entry)
        _percent(axes)
    for axes in grid.flat[len(entries) :]:
        axes.set_visible(False)
    for axes in grid[:, 0]:
        axes.set_ylabel("score")
    save_figure(figure, path)


def _of(trials: Sequence[TrialRow], state: str) -> list[TrialRow]:
    return [trial for trial in trials if trial.state == state and trial.score is not None]


def _places(entry: Entry, trials: Sequence[TrialRow]) -> list[float]:
    """Where trials lie along the axis of an option: choices side by side, spread a little."""
    if entry.kind != "choice":
        return [trial.values[entry.name] for trial in trials]
    spread = np.random.default_rng(0).uniform(-0.2, 0.2, len(trials))
    return [
        entry.values.index(trial.values[entry.name]) + dx for trial, dx in zip(trials, spread, strict=True)
    ]


def _scale(axes: Axes, entry: Entry) -> None:
    """The whole range of an option along the x axis."""
    if entry.kind == "choice":
        axes.set_xticks(range(len(entry.values)), [str(value) for value in entry.values])
        axes.set_xlim(-0.5, len(entry.values) - 0.5)
        return
    assert entry.low is not None
    assert entry.high is not None
    if entry.kind.startswith("log"):
        margin = (entry.high / entry.low) ** 0.04
        axes.set(xscale="log", xlim=(entry.low / margin, entry.high * margin))
        decades = np.log10(entry.high / entry.low)
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if decades < 2 else (1.0,)))
        axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes.xaxis.set_minor_formatter(NullFormatter())
        return
    margin = 0.04 * (entry.high - entry.low)
    axes.set_xlim(entry.low - margin, entry.high + margin)
    axes.xaxis.set_major_locator(MaxNLocator(5, integer=entry.kind == "int"))


def _scatter(
    axes: Axes,
    at: Sequence[float],
    done: Sequence[TrialRow],
    beside: Sequence[float],
    pruned: Sequence[TrialRow],
) -> None:
    axes.scatter(at, [trial.score or 0.0 for trial in done], s=18, color=_COLOR, label="trials", zorder=3)
    scores = [trial.score or 0.0 for trial in pruned]
    axes.scatter(beside, scores, s=18, facecolors="none", edgecolors=_PALE, label="pruned", zorder=2)
    axes.grid(alpha=0.3)


def _percent(axes: Axes) -> None:
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
