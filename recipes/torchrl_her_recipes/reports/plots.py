"""Plots of a study, one panel in each picture, so that a page can arrange them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter, PercentFormatter

from torchrl_her_envs.common.goal_env import GoalEnv
from torchrl_her_recipes.reports.compare import Final
from torchrl_her_recipes.runs.plots import Rows, by_frames, draw_curves, draw_goals

_WIDTH, _HEIGHT = 4.4, 3.9  # inches: as wide as a phone, in letters that can be read there
_INK = "#1a202c"


def plot_measure(
    curves: Mapping[str, Rows],
    name: str,
    stem: Path,
    *,
    title: str,
    palette: Mapping[str, str],
    beside: str | None = None,
) -> None:
    """Draws one metric of several algorithms, as a .svg and a .png.

    Args:
        curves: label to table of metrics.
        name: name of the metric.
        stem: path of the pictures, without an ending.
        title: above it.
        palette: label to color.
        beside: a second metric, the median of which is drawn dashed.
    """
    figure, axes = _panel(title)
    draw_curves(axes, curves, name, palette)
    if beside is not None:
        for label, rows in curves.items():
            frames, values = by_frames(rows, beside)
            middle = np.median(values, axis=1)
            axes.plot(frames, middle, color=palette[label], linestyle="--", linewidth=1.2)
    handles, _ = axes.get_legend_handles_labels()
    if beside is not None:
        handles += [Line2D([], [], color=_INK, linestyle="--", label=beside)]
    axes.set_xlabel("environment steps of each run")
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    if name.startswith("rows_"):
        axes.yaxis.set_major_formatter(EngFormatter(sep=""))
    figure.legend(handles=handles, loc="outside lower center", ncols=2, frameon=False)
    _save(figure, stem)


def plot_finals(
    finals: Mapping[str, tuple[Sequence[float], Final]],
    stem: Path,
    *,
    title: str,
    palette: Mapping[str, str],
) -> None:
    """Draws success at the end: each run, the interquartile mean with its interval, the published number."""
    figure, axes = _panel(title, height=1.5 + 0.42 * len(finals))
    for place, (label, (values, final)) in enumerate(finals.items()):
        color = palette[label]
        axes.scatter(values, [place + 0.22] * len(values), s=9, color=color, alpha=0.45, linewidths=0)
        axes.plot([final.low, final.high], [place, place], color=color, linewidth=4, alpha=0.5)
        axes.plot([final.iqm], [place], "o", color=color, markersize=6)
        if final.published is not None:
            axes.plot([final.published], [place], "D", color=_INK, markersize=6, fillstyle="none")
    axes.set(ylim=(len(finals) - 0.5, -0.5), xlim=(-0.02, 1.02), xlabel="success at the end")
    axes.set_yticks(range(len(finals)), list(finals))
    axes.xaxis.set_major_formatter(PercentFormatter(1.0))
    axes.grid(axis="x", alpha=0.3)
    if any(final.published is not None for _, final in finals.values()):
        mark = Line2D([], [], marker="D", linestyle="", color=_INK, fillstyle="none", label="published")
        figure.legend(handles=[mark], loc="outside lower center", frameon=False)
    _save(figure, stem)


def plot_share(share: np.ndarray, env: GoalEnv, stem: Path, *, limit: float, title: str) -> None:
    """Draws one heat map of goals [n, n] over the screen, as a .svg and a .png."""
    figure = Figure(figsize=(2.5, 2.7), layout="constrained")
    axes = figure.subplots()
    draw_goals(axes, share, env, limit=limit)
    axes.set(xticks=[], yticks=[])
    axes.set_title(title, fontsize=10)
    _save(figure, stem)


def _panel(title: str, *, height: float = _HEIGHT) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(_WIDTH, height), layout="constrained")
    axes = figure.subplots()
    axes.set_title(title)
    return figure, axes


def _save(figure: Figure, stem: Path) -> None:
    """Writes a picture as .svg, and as .png for programs that cannot show that."""
    figure.savefig(f"{stem}.svg", metadata={"Date": None})
    figure.set_layout_engine("none")  # it is laid out already, which takes longer than drawing it
    figure.savefig(f"{stem}.png", dpi=120)
