"""What there is of single runs, and of a folder of them, for a page; also while they go on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from torchrl_her_recipes.config.study import Study
from torchrl_her_recipes.reports.page import write_page
from torchrl_her_recipes.reports.results import read_single
from torchrl_her_recipes.reports.tidy import Results, is_results, read_study
from torchrl_her_recipes.studies.seed_batches import Batches

_FILMS = (".gif", ".mp4")


def read_runs(folders: Sequence[Path]) -> Results:
    """What there is of some runs, each of which is an algorithm of its own on the page.

    Args:
        folders: of runs, or of batches of seeds (``seeds_*``), or with such folders in them.

    Raises:
        ValueError: one of them has no run, or a run cannot be read.
    """
    paths = [path for folder in folders for path in runs_in(folder)]
    labels = _labels(paths)
    batches = [Batches(path) for path in paths]
    # Asked first: what ends after this is shown in a later version of the page.
    over = all(home.policy.exists() for own in batches for home in own.homes)
    cells = [read_single(label, own) for label, own in zip(labels, batches, strict=True)]
    return Results(
        kind="runs",
        name=", ".join(folder.resolve().name for folder in folders),
        summary=", ".join(dict.fromkeys(cell.task for cell in cells)),
        cells=cells,
        over=over,
        film=newest_film(paths),
    )


def write_runs_report(folders: Sequence[Path], out: Path) -> Path:
    """Writes a page about single runs, of which some may not be at their end; trains nothing.

    Args:
        folders: of runs, or of folders with runs in them.
        out: where the page goes, its tables, and its pictures into `figures`.

    Returns:
        The page.

    Raises:
        ValueError: a folder has no run, or one cannot be read.
        OSError: the page cannot be written.
    """
    return write_page(read_runs(folders), out)


def read_study_so_far(study: Study, folder: Path) -> Results:
    """What there is of a study so far, of which there may be nothing yet.

    Raises:
        ValueError: a run cannot be read.
    """
    if is_results(folder):
        return read_study(study, folder)
    paths = [folder / label for label, _ in study.cells()]
    results = read_study(study, folder, nothing_yet=True)
    over = all(cell.whole for cell in results.cells)
    return replace(results, over=over, film=newest_film(paths))


def newest_film(folders: Sequence[Path]) -> tuple[Path, str] | None:
    """The film that was made last in the folders of runs, and what it shows; None if there is none.

    Example:
        >>> newest_film([Path("nowhere")])
    """
    homes = [home.path for folder in folders for home in Batches(folder).homes]
    newest = max((path for home in homes for path in films_of(home)), key=_time, default=None)
    return (
        None if newest is None else (newest, f"The newest film, {newest.parent.resolve().name}/{newest.name}")
    )


def films_of(home: Path) -> list[Path]:
    """The films in the folder of a run that are written to their ends."""
    return [
        path for path in sorted(home.glob("*.*")) if path.suffix in _FILMS and not path.stem.endswith(".part")
    ]


def signature(folders: Sequence[Path]) -> list[tuple[str, int, int]]:
    """What tells whether there is something new in the folders of runs: their files, with times and sizes."""
    homes = [home for folder in folders for home in Batches(folder).homes]
    files = [
        path
        for home in homes
        for path in (home.metrics, home.policy, home.best, home.goal_map, *films_of(home.path))
    ]
    return [(str(path), *_state(path)) for path in files]


def _state(path: Path) -> tuple[int, int]:
    try:
        about = path.stat()
    except OSError:  # it was replaced just now
        return 0, 0
    return about.st_mtime_ns, about.st_size


def _time(path: Path) -> int:
    return _state(path)[0]


def runs_in(folder: Path) -> list[Path]:
    """The folders of runs that somebody means by a folder."""
    if Batches(folder).homes:
        return [folder]
    found = [path for path in sorted(folder.iterdir()) if path.is_dir() and Batches(path).homes]
    if not found:
        raise ValueError(f"{folder} is no folder of a run: neither it nor a folder in it has a config.yaml")
    return found


def _labels(paths: Sequence[Path]) -> list[str]:
    """The last part of each path; all of it where that does not tell them apart."""
    names = [path.resolve().name for path in paths]
    return [name if names.count(name) == 1 else str(path) for name, path in zip(names, paths, strict=True)]
