"""Draws curves of metrics over environment steps, and heat maps of virtual goals."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import EngFormatter, MaxNLocator

from torchrl_her.files.writing import written
from torchrl_her_envs.common.goal_env import Box, GoalEnv
from torchrl_her_recipes.config.metrics import AXES
from torchrl_her_recipes.runs.goal_map import GoalMap

Rows = Sequence[dict[str, float]]

COLORS = {  # color of each algorithm in all pictures; other labels use the remaining colors in this order
    "her": "#dd6b20",
    "filtered_her": "#805ad5",
    "filtered_her_ibs": "#2b6cb0",
    "her_ibs": "#38a169",
    "unfiltered_cher": "#d53f8c",
    "her_ibs_sequential": "#718096",
    "no_hindsight": "#1a202c",
    "cher": "#c53030",
    "cher_ibs": "#0bc5ea",
    "unfiltered_cher_ibs": "#975a16",
}
# Metrics that are drawn for each run.
_PANELS = (
    "success",
    "distance",
    "q_bias",
    "loss_value",
    "rows_real_positive",
    "rows_useful_virtual_positive",
)
_REGIONS = {"goals": "#63b3ed", "reach": "#fc8181"}
_MOST_LINES = 15  # largest number of runs for which each run has a line of its own
_MOST_COLUMNS = 6  # largest number of panels side by side
_SCREEN = 300  # width and height in pixels of the picture behind a heat map


def plot_curves(rows: Rows, path: Path, *, title: str = "") -> None:
    """Draws the main metrics over environment steps; for several runs, with median and percentiles."""
    figure = Figure(figsize=(14, 6), layout="constrained")
    figure.suptitle(title)
    changes = stage_changes(rows)
    for axes, name in zip(figure.subplots(2, 3).flat, _PANELS, strict=True):
        if all(name in row for row in rows):
            draw_curve(axes, rows, name)
        if name == "success" and any(row.get("reached", row[name]) != row[name] for row in rows):
            frames, _, middle, _ = band(rows, "reached")
            axes.plot(frames, middle, "--", color="#dd6b20", label="reached at some step")
            axes.legend(fontsize=8)
        for change in changes:
            axes.axvline(change, color="#a0aec0", linewidth=0.8, linestyle=":")
        axes.set_xlabel("environment steps")
        _set_up(axes, name)
    several = len({row["run"] for row in rows}) > 1
    legend = ["line: median, band: 33rd to 67th percentile, thin lines: single runs"] if several else []
    legend += ["dotted: a run enters the next stage"] if changes else []
    figure.supxlabel("; ".join(legend), fontsize=9)
    save_figure(figure, path)


def save_figure(figure: Figure, path: Path) -> None:
    """Writes a picture to a file; an interrupted write leaves no partial file."""
    with written(path) as part:
        figure.savefig(part, dpi=110)


def plot_comparison(
    panels: Mapping[str, Mapping[str, Rows]], path: Path, *, metrics: Sequence[str] = ("success",)
) -> None:
    """Draws metrics over environment steps as medians with bands from the 33rd to the 67th percentile.

    Args:
        panels: for each title of a panel, its curves; for each label of a curve, the table of its runs.
        path: path of the picture.
        metrics: metrics to draw. With several of them and several titles, each metric has a row of panels.
    """
    columns = [(title, curves, name) for name in metrics for title, curves in panels.items()]
    one_metric = len(metrics) == 1 or len(panels) > 1  # whether the panels of a row draw the same metric
    rows = len(metrics) if one_metric else 1
    if len(metrics) == 1:
        rows = math.ceil(len(columns) / _MOST_COLUMNS)
    width = math.ceil(len(columns) / rows)
    figure = Figure(figsize=(1.0 + 4.2 * width, 3.8 * rows), layout="constrained")
    grid = figure.subplots(rows, width, sharey="row" if one_metric else False, squeeze=False)
    for axes, (title, curves, name) in zip(grid.flat, columns, strict=False):
        draw_curves(axes, curves, name, colors(list(curves)))
        axes.set(title=title, xlabel="environment steps of each run")
        axes.legend(fontsize=8)
        if one_metric and axes not in grid[:, 0]:
            axes.set_ylabel("")
    for axes in grid.flat[len(columns) :]:
        axes.set_visible(False)
    grid[0, 0].set_ylabel(f"{grid[0, 0].get_ylabel()}\n(median, 33rd to 67th percentile)")
    save_figure(figure, path)


def colors(labels: Sequence[str]) -> dict[str, str]:
    """Returns a color for each label: a fixed color for algorithms, the unused colors in turn for others.

    Example:
        >>> colors(["her", "window=20"])
        {'her': '#dd6b20', 'window=20': '#805ad5'}
    """
    fixed = {label: COLORS[label] for label in labels if label in COLORS}
    left = cycle([color for color in COLORS.values() if color not in fixed.values()] or COLORS.values())
    return {label: fixed.get(label) or next(left) for label in labels}


def draw_curves(axes: Axes, curves: Mapping[str, Rows], name: str, palette: Mapping[str, str]) -> None:
    """Draws curves of one metric over environment steps on given axes, with labels and limits."""
    for label, rows in curves.items():
        draw_curve(axes, rows, name, color=palette[label], label=label)
    _set_up(axes, name)


def _set_up(axes: Axes, name: str) -> None:
    """Sets the label, limits, grid and number format of the axes on which a metric is drawn."""
    label, limits = AXES[name]
    axes.set_ylabel(label)
    count_frames(axes)
    axes.grid(alpha=0.3)
    if limits is not None:
        axes.set_ylim(*limits)


def count_frames(axes: Axes) -> None:
    """Formats the x axis for environment steps: few ticks, with numbers such as 200k."""
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))


def stage_changes(rows: Rows) -> list[float]:
    """Returns the numbers of frames after which a run entered another stage of its curriculum."""
    last: dict[float, dict[str, float]] = {}
    changes = []
    for row in rows:
        before = last.get(row["run"], row)
        if row.get("stage") != before.get("stage"):
            changes.append(before["frames"])
        last[row["run"]] = row
    return changes


def draw_curve(
    axes: Axes,
    rows: Rows,
    name: str,
    *,
    color: str = "#2b6cb0",
    label: str | None = None,
) -> None:
    """Draws one metric of some runs on given axes: median, 33rd to 67th percentile, and single runs."""
    frames, low, middle, high = band(rows, name)
    runs = by_frames(rows, name)[1]
    if 1 < runs.shape[1] <= _MOST_LINES:
        axes.plot(frames, runs, color=color, linewidth=0.6, alpha=0.4)
    axes.plot(frames, middle, color=color, label=label, marker="o" if len(frames) == 1 else None)
    axes.fill_between(frames, low, high, color=color, alpha=0.25, linewidth=0)


def band(rows: Rows, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Returns the frames of n evaluations and a metric's 33rd, 50th and 67th percentile there, [n] each."""
    frames, values = by_frames(rows, name)
    low, middle, high = np.percentile(values, [33, 50, 67], axis=1)
    return frames, low, middle, high


def by_frames(rows: Rows, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Returns the frames [n] of n evaluations, and the values [n, R] of a metric of R runs."""
    if missing := [row for row in rows if name not in row]:
        raise ValueError(f"these runs did not measure {name}; they have {', '.join(missing[0])}")
    groups: dict[float, list[float]] = {}
    for row in rows:
        groups.setdefault(row["frames"], []).append(row[name])
    return np.array(list(groups)), np.array(list(groups.values()))


def plot_goals(goals: GoalMap, env: GoalEnv, path: Path, *, title: str = "") -> None:
    """Draws heat maps of virtual goals and of their target q*, side by side, with the same color scale."""
    figure = Figure(figsize=(9.6, 4.6), layout="constrained")
    figure.suptitle(title)
    limit = max(float(goals.target.max()), 1e-9)
    panels = figure.subplots(1, 2)
    for axes, share, name in zip(
        panels, (goals.share, goals.target), ("written: q", "target: q*"), strict=True
    ):
        draw_goals(axes, share, env, limit=limit)
        axes.set_title(name)
    figure.colorbar(panels[0].images[-1], ax=panels, label="share of virtual goals in a cell", extend="max")
    save_figure(figure, path)


def draw_goals(axes: Axes, share: np.ndarray, env: GoalEnv, *, limit: float) -> None:
    """Draws a heat map [n, n] over a picture of the environment; its color scale ends at ``limit``.

    The environment defines the box of its goals, the edges of its picture, and regions to outline. If it has
    no picture, the heat map is drawn on white.

    Raises:
        ValueError: the environment does not define a two-dimensional box of goals.
    """
    box = env.goal_box()
    if box is None or len(box[0]) != 2:
        raise ValueError(
            f"goals of {env.task_name} cannot be drawn: goal_box() must return a box of two coordinates"
        )
    frame = env.picture_box()
    if frame is not None:
        axes.imshow(env.render(0, size=_SCREEN).numpy(), extent=_extent(frame))
    (left, bottom), (right, top) = box
    heat = share.T
    alpha = np.clip(heat / limit, 0.0, 1.0) ** 0.5  # the picture stays visible where there are few goals
    axes.imshow(heat, origin="lower", cmap="magma", vmin=0.0, vmax=limit, alpha=alpha, extent=_extent(box))
    for name, ((x, y), (x_end, y_end)) in env.regions().items():
        color = _REGIONS.get(name, "#718096")
        axes.add_patch(Rectangle((x, y), x_end - x, y_end - y, fill=False, edgecolor=color, linewidth=1.5))
    middle = [(left + right) / 2, (bottom + top) / 2]
    axes.set(xlim=(left, right), ylim=(bottom, top))
    axes.set(xticks=[left, middle[0], right], yticks=[bottom, middle[1], top])


def _extent(box: Box) -> tuple[float, float, float, float]:
    """Converts a box to matplotlib's ``extent``: left, right, bottom, top."""
    (left, bottom), (right, top) = box
    return left, right, bottom, top
