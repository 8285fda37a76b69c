"""Draws the pictures of a report into files, with alternative texts."""

from __future__ import annotations

import base64
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from torchrl_her_envs.registry import make_env
from torchrl_her_envs.throwing.env import ThrowingEnv
from torchrl_her_envs.throwing.tasks import TASKS
from torchrl_her_recipes.reports.compare import Final, values_of
from torchrl_her_recipes.reports.formatting import MEASURES, show, show_interval
from torchrl_her_recipes.reports.plots import plot_finals, plot_measure, plot_share
from torchrl_her_recipes.reports.results import Combination
from torchrl_her_recipes.runs.plots import Rows, band, colors

_MIME = {".svg": "image/svg+xml", ".png": "image/png", ".gif": "image/gif", ".mp4": "video/mp4"}


@dataclass(frozen=True)
class Picture:
    """A picture or film of the page.

    Attributes:
        file: that is embedded.
        alt: alternative text.
    """

    file: Path
    alt: str

    @property
    def uri(self) -> str:
        """The whole picture as a data URI."""
        data = base64.b64encode(self.file.read_bytes()).decode()
        return f"data:{_MIME[self.file.suffix]};base64,{data}"


def draw_pictures(
    cells: Sequence[Combination], finals: Sequence[Final], figures: Path
) -> dict[str, list[Picture]]:
    """Draws all pictures: figures with a panel for each task, and a figure of heat maps for each task."""
    pictures: dict[str, list[Picture]] = {}
    palette = colors(list(dict.fromkeys(cell.algorithm for cell in cells)))
    for task in dict.fromkeys(cell.task for cell in cells):
        own = [cell for cell in cells if cell.task == task]
        for name in (*MEASURES, "q"):
            curves = {cell.algorithm: cell.rows for cell in own if cell.has(name)}
            if curves and name != "kl":
                pictures.setdefault(name, []).append(_curve(task, name, curves, palette, figures))
        reached = {row.algorithm: row for row in finals if (row.measure, row.task) == ("success", task)}
        ends = {
            cell.algorithm: (values_of(cell, "success"), reached[cell.algorithm])
            for cell in own
            if cell.algorithm in reached
        }
        if ends:
            pictures.setdefault("finals", []).append(_final(task, ends, palette, figures))
        pictures[f"goals_{task}"] = _goals(task, own, figures)
    return pictures


def _curve(
    task: str, name: str, curves: Mapping[str, Rows], palette: Mapping[str, str], figures: Path
) -> Picture:
    beside = "return" if name == "q" else None
    stem = _stem(figures, name, task)
    plot_measure(curves, name, stem, title=task, palette=palette, beside=beside)
    ends = ", ".join(
        f"{label} {show(float(band(rows, name)[2][-1]), name)}" for label, rows in curves.items()
    )
    what = MEASURES.get(name, "Q of the initial state")
    return Picture(Path(f"{stem}.svg"), f"{task}: {what} over environment steps. Last medians: {ends}.")


def _final(
    task: str,
    ends: Mapping[str, tuple[Sequence[float], Final]],
    palette: Mapping[str, str],
    figures: Path,
) -> Picture:
    stem = _stem(figures, "final", task)
    plot_finals(ends, stem, title=task, palette=palette)
    said = ", ".join(f"{label} {show_interval(row, 'success')}" for label, (_, row) in ends.items())
    return Picture(Path(f"{stem}.svg"), f"{task}: success at the end. {said}.")


def _goals(task: str, cells: Sequence[Combination], figures: Path) -> list[Picture]:
    """Draws a heat map of each algorithm's virtual goals, and one of their target."""
    if task not in TASKS:
        return []  # there is no screen to draw them on
    maps = {cell.algorithm: cell.goals for cell in cells if cell.goals is not None}
    if not maps:
        return []
    env = make_env(task)
    env.reset()
    target = next(iter(maps.values())).target
    shares = {label: goals.share for label, goals in maps.items()} | {"target q*": target}
    return [_map(task, label, share, env, float(target.max()), figures) for label, share in shares.items()]


def _map(task: str, label: str, share: np.ndarray, env: ThrowingEnv, limit: float, figures: Path) -> Picture:
    stem = _stem(figures, "goals", task, label)
    plot_share(share, env, stem, limit=max(limit, 1e-9), title=f"{task}\n{label}")
    return Picture(Path(f"{stem}.png"), f"{task}: where the virtual goals of {label} lie on the screen.")


def _stem(figures: Path, *words: str) -> Path:
    """Returns the name of a picture, in characters that every file system allows."""
    return figures / re.sub(r"[^\w.=-]+", "_", "_".join(words))
