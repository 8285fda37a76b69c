"""Draws the pictures of a report, each panel in a file of its own, with alternative texts for the page."""

from __future__ import annotations

import base64
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter, PercentFormatter

from torchrl_her_envs.registry import make_env
from torchrl_her_envs.throwing.tasks import TASKS
from torchrl_her_recipes.reports.compare import Final, values_of
from torchrl_her_recipes.reports.formatting import MEASURES, show, show_interval
from torchrl_her_recipes.reports.results import Combination
from torchrl_her_recipes.runs.plots import Rows, band, colors, draw_curves, draw_goals

_MIME = {".svg": "image/svg+xml", ".png": "image/png", ".gif": "image/gif", ".mp4": "video/mp4"}
_WIDTH, _HEIGHT = 4.4, 3.9  # size in inches, narrow enough that text is readable on a phone
_INK = "#1a202c"


@dataclass(frozen=True)
class Picture:
    """A picture or film on the page.

    Attributes:
        file: path of the file, which is embedded in the page.
        alt: alternative text, which describes the picture.
    """

    file: Path
    alt: str

    @property
    def uri(self) -> str:
        """The file's content as a data URI, so that the page needs no other files."""
        data = base64.b64encode(self.file.read_bytes()).decode()
        return f"data:{_MIME[self.file.suffix]};base64,{data}"


def draw_pictures(
    cells: Sequence[Combination], finals: Sequence[Final], figures: Path
) -> dict[str, list[Picture]]:
    """Draws the panels of all figures, by figure: metrics for each task, heat maps for each algorithm."""
    pictures: dict[str, list[Picture]] = {}
    palette = colors(list(dict.fromkeys(cell.algorithm for cell in cells)))
    for task in dict.fromkeys(cell.task for cell in cells):
        task_cells = [cell for cell in cells if cell.task == task]
        for name in (*MEASURES, "q"):
            curves = {cell.algorithm: cell.rows for cell in task_cells if cell.has(name)}
            if curves and name != "kl":
                pictures.setdefault(name, []).append(_curve(task, name, curves, palette, figures))
        reached = {row.algorithm: row for row in finals if (row.measure, row.task) == ("success", task)}
        ends = {
            cell.algorithm: (values_of(cell, "success"), reached[cell.algorithm])
            for cell in task_cells
            if cell.algorithm in reached
        }
        if ends:
            pictures.setdefault("finals", []).append(_final(task, ends, palette, figures))
        pictures[f"goals_{task}"] = _goals(task, task_cells, figures)
    return pictures


def _curve(
    task: str, name: str, curves: Mapping[str, Rows], palette: Mapping[str, str], figures: Path
) -> Picture:
    """Draws a metric of several algorithms over environment steps; with Q, also draws returns (dashed)."""
    figure, axes = _panel(task)
    draw_curves(axes, curves, name, palette)
    handles, _ = axes.get_legend_handles_labels()
    if name == "q":
        for label, rows in curves.items():
            frames, _, middle, _ = band(rows, "return")
            axes.plot(frames, middle, color=palette[label], linestyle="--", linewidth=1.2)
        handles += [Line2D([], [], color=_INK, linestyle="--", label="return")]
    axes.set_xlabel("environment steps of each run")
    if name.startswith("rows_"):
        axes.yaxis.set_major_formatter(EngFormatter(sep=""))
    figure.legend(handles=handles, loc="outside lower center", ncols=2, frameon=False)
    ends = ", ".join(
        f"{label} {show(float(band(rows, name)[2][-1]), name)}" for label, rows in curves.items()
    )
    quantity = MEASURES.get(name, "Q of the initial state")
    path = _save(figure, figures, name, task)
    return Picture(path, f"{task}: {quantity} over environment steps. Last medians: {ends}.")


def _final(
    task: str,
    ends: Mapping[str, tuple[Sequence[float], Final]],
    palette: Mapping[str, str],
    figures: Path,
) -> Picture:
    """Draws success at the end of training: runs, interquartile means with intervals, published numbers."""
    figure, axes = _panel(task, height=1.5 + 0.42 * len(ends))
    for place, (label, (values, final)) in enumerate(ends.items()):
        color = palette[label]
        axes.scatter(values, [place + 0.22] * len(values), s=9, color=color, alpha=0.45, linewidths=0)
        axes.plot([final.low, final.high], [place, place], color=color, linewidth=4, alpha=0.5)
        axes.plot([final.iqm], [place], "o", color=color, markersize=6)
        if final.published is not None:
            axes.plot([final.published], [place], "D", color=_INK, markersize=6, fillstyle="none")
    axes.set(ylim=(len(ends) - 0.5, -0.5), xlim=(-0.02, 1.02), xlabel="success at the end")
    axes.set_yticks(range(len(ends)), list(ends))
    axes.xaxis.set_major_formatter(PercentFormatter(1.0))
    axes.grid(axis="x", alpha=0.3)
    if any(final.published is not None for _, final in ends.values()):
        mark = Line2D([], [], marker="D", linestyle="", color=_INK, fillstyle="none", label="published")
        figure.legend(handles=[mark], loc="outside lower center", frameon=False)
    text = ", ".join(f"{label} {show_interval(row, 'success')}" for label, (_, row) in ends.items())
    path = _save(figure, figures, "final", task)
    return Picture(path, f"{task}: success at the end. {text}.")


def _goals(task: str, cells: Sequence[Combination], figures: Path) -> list[Picture]:
    """Draws heat maps of each algorithm's virtual goals and of their target, for throwing tasks only."""
    maps = {cell.algorithm: cell.goals for cell in cells if cell.goals is not None}
    if task not in TASKS or not maps:  # only goals of the throwing tasks lie on a screen
        return []
    env = make_env(task)
    env.reset()
    target = next(iter(maps.values())).target
    limit = max(float(target.max()), 1e-9)
    shares = {label: goals.share for label, goals in maps.items()} | {"target q*": target}
    pictures = []
    for label, share in shares.items():
        figure = Figure(figsize=(2.5, 2.7), layout="constrained")
        axes = figure.subplots()
        draw_goals(axes, share, env, limit=limit)
        axes.set(xticks=[], yticks=[])
        axes.set_title(f"{task}\n{label}", fontsize=10)
        path = _save(figure, figures, "goals", task, label).with_suffix(".png")
        pictures.append(Picture(path, f"{task}: where the virtual goals of {label} lie on the screen."))
    return pictures


def _panel(title: str, *, height: float = _HEIGHT) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(_WIDTH, height), layout="constrained")
    axes = figure.subplots()
    axes.set_title(title)
    return figure, axes


def _save(figure: Figure, figures: Path, *words: str) -> Path:
    """Writes a figure as .svg and, for programs that cannot show it, as .png; returns the .svg's path.

    The files are named by the words, in characters that every file system allows.
    """
    stem = re.sub(r"[^\w.=-]+", "_", "_".join(words))
    path = figures / f"{stem}.svg"
    figure.savefig(path, metadata={"Date": None})
    figure.set_layout_engine("none")  # keeps the layout: computing it again takes longer than drawing
    figure.savefig(figures / f"{stem}.png", dpi=120)
    return path
