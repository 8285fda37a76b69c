"""Pictures of a run: its curves, and where its virtual goals lie."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from torch import Tensor

from torchrl_her_envs import ThrowingEnv

matplotlib.use("agg")

_PANELS = (
    ("success", "success rate", (-0.02, 1.02)),
    ("distance", "distance to goal at the end", None),
    ("q_bias", "Q of the start minus return", None),
    ("loss_value", "critic's loss", None),
)


def plot_curves(rows: Sequence[dict[str, float]], path: Path, *, title: str = "") -> None:
    """Draws the curves of a run; of several ones the median, and the 33rd to 67th percentile.

    Args:
        rows: the table of metrics, one row an epoch and run.
        path: of the picture.
        title: above it.
    """
    figure = Figure(figsize=(10, 6), layout="constrained")
    figure.suptitle(title)
    for axes, (name, label, limits) in zip(figure.subplots(2, 2).flat, _PANELS, strict=True):
        if all(name in row for row in rows):
            draw_curve(axes, rows, name)
        axes.set(xlabel="environment steps", ylabel=label)
        axes.grid(alpha=0.3)
        if limits is not None:
            axes.set_ylim(*limits)
    figure.savefig(path, dpi=110)


def draw_curve(
    axes: Axes,
    rows: Sequence[dict[str, float]],
    name: str,
    *,
    colour: str = "#2b6cb0",
    label: str | None = None,
) -> None:
    """One metric over environment steps, on given axes: median, and 33rd to 67th percentile."""
    frames, values = by_frames(rows, name)
    low, middle, high = np.percentile(values, [33, 50, 67], axis=1)
    axes.plot(frames, middle, color=colour, label=label)
    axes.fill_between(frames, low, high, color=colour, alpha=0.25, linewidth=0)


def by_frames(rows: Sequence[dict[str, float]], name: str) -> tuple[np.ndarray, np.ndarray]:
    """One metric as (frames [n], values [n, R])."""
    groups: dict[float, list[float]] = {}
    for row in rows:
        groups.setdefault(row["frames"], []).append(row[name])
    return np.array(list(groups)), np.array(list(groups.values()))


def plot_goals(goals: Tensor, env: ThrowingEnv, path: Path, *, title: str = "", cells: int = 40) -> None:
    """Draws where virtual goals lie on the screen, beside the box of the real goals.

    Args:
        goals: [n, 2], in shown coordinates.
        env: of the task.
        path: of the picture.
        title: above it.
        cells: of the histogram, in each direction.
    """
    figure = Figure(figsize=(5.6, 5), layout="constrained")
    axes = figure.subplots()
    draw_goals(axes, goals, env, cells=cells)
    axes.set_title(title)
    figure.colorbar(axes.images[0], ax=axes, label="share of virtual goals")
    figure.savefig(path, dpi=110)


def draw_goals(axes: Axes, goals: Tensor, env: ThrowingEnv, *, cells: int = 40, limit: float = 0.01) -> None:
    """The histogram of :func:`plot_goals` on given axes; its colours end at a share of ``limit`` a cell."""
    counts, _ = torch.histogramdd(goals.double().cpu(), bins=[cells, cells], range=[-1.0, 1.0, -1.0, 1.0])
    share = (counts / counts.sum().clamp_min(1.0)).T
    axes.imshow(share, origin="lower", extent=(-1, 1, -1, 1), cmap="magma", vmin=0.0, vmax=limit)
    (x, y), (x_end, y_end) = env.goal_distribution.low.tolist(), env.goal_distribution.high.tolist()
    left, bottom, right, top = (2.0 * side - 1.0 for side in env.effector.reach)
    for corner, size, colour in (
        ((x, y), (x_end - x, y_end - y), "#63b3ed"),
        ((left, bottom), (right - left, top - bottom), "#fc8181"),
    ):
        axes.add_patch(Rectangle(corner, *size, fill=False, edgecolor=colour, linewidth=1.5))
    axes.set(xlim=(-1, 1), ylim=(-1, 1), xticks=[-1, 0, 1], yticks=[-1, 0, 1])
