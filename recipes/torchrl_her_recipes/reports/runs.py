"""Writes a page about single runs or about a folder of runs, finished or not."""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

from torchrl_her_recipes.config.recipe import Recipe
from torchrl_her_recipes.reports.page import write_page
from torchrl_her_recipes.reports.pictures import Picture
from torchrl_her_recipes.reports.results import read_single
from torchrl_her_recipes.reports.tidy import Results
from torchrl_her_recipes.studies.seed_batches import Batches

_FILMS = (".gif", ".mp4")
_LARGEST = 20_000_000  # largest size in bytes of a video that is embedded in the page


def read_runs(folders: Sequence[Path]) -> Results:
    """Reads runs for a page; runs that differ only in their seeds form one algorithm.

    Args:
        folders: folders of runs, folders with batches of seeds (``seeds_*``), or folders that contain such
            folders.
    """
    paths = [path for folder in folders for path in _runs_in(folder)]
    groups = _by_recipe(paths)
    cells = [
        read_single(label, Batches(*group)) for label, group in zip(_labels(groups), groups, strict=True)
    ]
    return Results(
        kind="runs",
        name=", ".join(folder.resolve().name for folder in folders),
        summary=", ".join(dict.fromkeys(cell.task for cell in cells)),
        cells=cells,
        film=_newest_film(paths),
    )


def write_runs_report(folders: Sequence[str | Path], out: str | Path) -> Path:
    """Writes a page about single runs, finished or not, without training anything.

    Args:
        folders: folders of runs, or folders that contain folders of runs.
        out: folder for the page and its tables; pictures are written to its folder ``figures``.

    Returns:
        The path of the page.

    Raises:
        ValueError: a folder has no run, or a run cannot be read.
        OSError: the page cannot be written.
    """
    return write_page(read_runs([Path(folder) for folder in folders]), Path(out))


def _newest_film(folders: Sequence[Path]) -> Picture | None:
    """Returns the newest video in folders of runs that is small enough for the page, or None."""
    homes = [home.path for folder in folders for home in Batches(folder).homes]
    films = [path for home in homes for path in home.glob("*.*") if path.suffix in _FILMS]
    whole = [path for path in films if not path.stem.endswith(".part") and path.stat().st_size <= _LARGEST]
    newest = max(whole, key=lambda path: path.stat().st_mtime, default=None)
    if newest is None:
        return None
    date = f"{datetime.fromtimestamp(newest.stat().st_mtime):%Y-%m-%d %H:%M}"
    return Picture(newest, f"The newest film, {newest.parent.resolve().name}/{newest.name}, {date}")


def _runs_in(folder: Path) -> list[Path]:
    """Returns a folder itself if it is the folder of a run, or else the folders of runs in it."""
    if Batches(folder).homes:
        return [folder]
    paths = [path for path in sorted(folder.iterdir()) if path.is_dir() and Batches(path).homes]
    if not paths:
        raise ValueError(f"{folder} is no folder of a run: neither it nor a folder in it has a config.yaml")
    return paths


def _by_recipe(paths: Sequence[Path]) -> list[list[Path]]:
    """Groups folders of runs; the runs of a group have the same options, but different seeds."""
    groups: list[tuple[Recipe, set[int], list[Path]]] = []
    for path in paths:
        recipes = [home.recipe() for home in Batches(path).homes]
        without_seeds = recipes[0].replace(seed=0, num_runs=1)
        seeds = {seed for recipe in recipes for seed in recipe.seeds}
        for recipe, others, group in groups:
            if recipe == without_seeds and not seeds & others:
                others |= seeds
                group.append(path)
                break
        else:
            groups.append((without_seeds, seeds, [path]))
    return [group for _, _, group in groups]


def _labels(groups: Sequence[Sequence[Path]]) -> list[str]:
    """Names groups by their first folders (without the seed, if a group has several), or else by its path."""
    names = [
        re.sub(r"_s\d+(_\d+)?$", "", group[0].resolve().name) if len(group) > 1 else group[0].resolve().name
        for group in groups
    ]
    return [
        name if names.count(name) == 1 else str(group[0]) for name, group in zip(names, groups, strict=True)
    ]
