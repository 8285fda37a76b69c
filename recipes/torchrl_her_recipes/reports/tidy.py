"""Writes the results of a study to a few small files, which replace the folders of its runs."""

from __future__ import annotations

import csv
import gzip
import json
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

import numpy as np

from torchrl_her_recipes.config.plain_files import (
    LARGEST_TABLE,
    dump_yaml,
    naming,
    number,
    read_json,
    read_mapping,
    reason,
)
from torchrl_her_recipes.config.study import Study
from torchrl_her_recipes.reports.pictures import Picture
from torchrl_her_recipes.reports.results import Combination, read_combinations
from torchrl_her_recipes.runs.folder import RunFolder
from torchrl_her_recipes.runs.goal_map import GoalMap, read_arrays
from torchrl_her_recipes.studies.seed_batches import Batches, number_runs

_ABOUT, _RUNS, _GOALS = "about.yaml", "runs.csv", "goals.npz"
_DAMAGE = (AttributeError, EOFError, LookupError, OSError, TypeError, ValueError, csv.Error, zlib.error)
_LARGE = 1_000_000  # size in bytes above which a table is compressed
_KEYS = ("seed", "epoch", "frames")  # columns that identify a row within its combination
_KEPT = ("task", "algorithm", "options", "done", "epochs", "planned", "seconds", "differs")


@dataclass(frozen=True, kw_only=True)
class Results:
    """Results of a study, or of single runs.

    Attributes:
        name: name of the study, or names of the folders of runs.
        summary: one-line description for users.
        cells: results of each combination.
        kind: origin of the results: a ``"study"`` or single ``"runs"``.
        expect, published: expected and published results, see :class:`~torchrl_her_recipes.Study`.
        film: the newest film of a policy, or None.
    """

    name: str
    summary: str
    cells: list[Combination]
    kind: Literal["study", "runs"] = "study"
    expect: Mapping[str, Sequence[str]] = field(default_factory=dict)
    published: Mapping[str, Any] = field(default_factory=dict)
    film: Picture | None = None


def is_results(folder: Path) -> bool:
    """Returns whether a folder has the files of :func:`write_results` instead of folders of runs."""
    return (folder / _ABOUT).is_file()


def read_study(study: Study, folder: Path) -> Results:
    """Reads the results of a study, from folders of runs or from files of :func:`write_results`.

    Args:
        study: study whose results are read.
        folder: folder with a folder for each combination, or with the files.
    """
    if not is_results(folder):
        facts = {name: getattr(study, name) for name in ("name", "summary", "expect", "published")}
        return Results(cells=read_combinations(study, folder), **facts)
    results = read_results(folder)
    if results.name != study.name:
        raise ValueError(f"{folder} holds results of the study {results.name}, not of {study.name}")
    return results


def write_results(
    study: Study, folder: str | Path, out: str | Path, *, command: str | Sequence[str] | None = None
) -> Path:
    """Writes the results of a study to a few small files, which suffice to make its report without the runs.

    - ``runs.csv`` has a row for each run and evaluation: the combination (``label``, ``task``, ``algorithm``
      and the other options that the study varies), ``seed``, ``epoch``, ``frames`` and all metrics, with six
      significant digits. Metrics that a combination lacks are empty. If the table is larger than one
      megabyte, it is compressed to ``runs.csv.gz``.
    - ``goals.npz`` has the histograms of virtual goals, ``LABEL.counts`` and ``LABEL.target`` for each
      combination. It is missing if virtual goals were not counted.
    - ``about.yaml`` has the command, the versions of packages, the date, the study's recipe, and the state of
      each combination.

    Args:
        study: study whose results are written.
        folder: folder with a folder for each combination; some may be missing or unfinished.
        out: folder for the files.
        command: the command or commands that trained the runs; by default ``torchrl-her study NAME``.

    Returns:
        The folder of the files.

    Raises:
        ValueError: the folder has none of the study's runs, or one of them cannot be read.
        OSError: the files cannot be written.
    """
    folder = Path(folder)
    cells = read_combinations(study, folder)
    described = {name: getattr(study, name) for name in ("cases", "for_task", "expect", "published")}
    about = {
        "study": study.name,
        "summary": study.summary,
        "command": command or f"torchrl-her study {study.name}",
        **_origin([home for cell in cells for home in Batches(folder / cell.label).homes]),
        "recipe": study.recipe,
        "vary": study.vary,
        **{name: values for name, values in described.items() if values},
    }
    return write_files(about, cells, Path(out))


def write_files(about: Mapping[str, Any], cells: Sequence[Combination], out: Path) -> Path:
    """Writes the files of :func:`write_results` for given facts about a study and given combinations."""
    out.mkdir(parents=True, exist_ok=True)
    _write_table(cells, out)
    _write_goals(cells, out / _GOALS)
    states = {cell.label: {name: getattr(cell, name) for name in _KEPT} for cell in cells}
    # Converted through JSON, since PyYAML's safe_dump refuses numpy's numbers and subclasses of dict.
    plain = json.loads(json.dumps({**about, "combinations": states}, default=np.generic.item))
    text = dump_yaml(plain, allow_unicode=True, width=110)
    # Written last: a folder with this file counts as results.
    (out / _ABOUT).write_text(text, encoding="utf-8")
    return out


def read_results(folder: Path) -> Results:
    """Reads the results of a study from the files that :func:`write_results` wrote to a folder."""
    path = folder / _ABOUT
    if not path.is_file():
        raise ValueError(f"{folder} holds no results: it has no {_ABOUT}")
    about, tables, maps = read_mapping(path), _read_table(folder), _read_goals(folder / _GOALS)
    try:
        cells = [
            Combination(
                label=label,
                rows=tables.get(label, []),
                goals=maps.get(label),
                **{name: state[name] for name in _KEPT},
            )
            for label, state in about["combinations"].items()
        ]
        statements = {name: about.get(name, {}) for name in ("expect", "published")}
        return Results(name=about["study"], summary=about["summary"], cells=cells, **statements)
    except (AttributeError, KeyError, TypeError) as error:
        raise ValueError(f"{path} is damaged: {error} is missing or of the wrong kind") from error


def _write_table(cells: Sequence[Combination], out: Path) -> None:
    names = dict.fromkeys(name for cell in cells for name in cell.options)
    # Options whose values are the task or the algorithm are left out, since both have columns already.
    options = [
        name
        for name in names
        if any(cell.options.get(name) not in (cell.task, cell.algorithm) for cell in cells)
    ]
    columns = dict.fromkeys(name for cell in cells for row in cell.rows for name in row)
    metrics = [name for name in columns if name not in (*_KEYS, "run")]
    plain, packed = out / _RUNS, out / f"{_RUNS}.gz"
    with open(plain, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["label", "task", "algorithm", *options, *_KEYS, *metrics])
        for cell in cells:
            head = [cell.label, cell.task, cell.algorithm, *(cell.options.get(name) for name in options)]
            for row in sorted(cell.rows, key=lambda row: (row["seed"], row["epoch"])):
                writer.writerow([*head, *(_number(row.get(name)) for name in (*_KEYS, *metrics))])
    packed.unlink(missing_ok=True)
    if plain.stat().st_size > _LARGE:
        # ``mtime=0`` leaves out the time stamp, so that equal results give equal bytes.
        packed.write_bytes(gzip.compress(plain.read_bytes(), mtime=0))
        plain.unlink()


def _number(value: float | None) -> str:
    """Formats a number with six significant digits, or a whole number with all its digits."""
    if value is None:
        return ""
    return str(int(value)) if float(value).is_integer() else f"{value:.6g}"


def _read_table(folder: Path) -> dict[str, list[dict[str, float]]]:
    """Reads the table of runs; returns each combination's rows by its label, sorted by epoch and run."""
    path, packed = folder / _RUNS, folder / f"{_RUNS}.gz"
    if not path.is_file() and not packed.is_file():
        raise ValueError(f"{folder} has no {_RUNS}")
    tables: dict[str, list[dict[str, float]]] = {}
    try:
        with open(path, "rb") if path.is_file() else gzip.open(packed) as file:
            text = file.read(LARGEST_TABLE + 1)
        if len(text) > LARGEST_TABLE:
            raise ValueError(f"it has more than {LARGEST_TABLE:,} bytes")
        lines = csv.DictReader(text.decode().splitlines())
        names = lines.fieldnames or []
        if not {"label", *_KEYS} <= set(names):
            raise ValueError(f"its columns are {', '.join(names)}")
        numbers = names.index("seed")  # earlier columns identify the combination
        for line in lines:
            row = {name: number(line[name]) for name in names[numbers:] if line[name] != ""}
            tables.setdefault(line["label"], []).append(row)
        return {label: number_runs(rows) for label, rows in tables.items()}
    except _DAMAGE as error:
        raise ValueError(f"the table of runs in {folder} is damaged: {reason(error)}") from error


def _write_goals(cells: Sequence[Combination], path: Path) -> None:
    arrays: dict[str, Any] = {}
    for cell in cells:
        if cell.goals is not None:
            counts = cell.goals.counts
            if (counts == counts.astype(np.uint64)).all():
                counts = counts.astype(np.min_scalar_type(int(counts.max(initial=0))))
            arrays |= {f"{cell.label}.counts": counts, f"{cell.label}.target": cell.goals.target}
    path.unlink(missing_ok=True)
    if arrays:
        np.savez_compressed(path, **arrays)


def _read_goals(path: Path) -> dict[str, GoalMap]:
    if not path.is_file():
        return {}
    arrays = read_arrays(path)
    labels = [name.removesuffix(".counts") for name in arrays if name.endswith(".counts")]
    return {label: GoalMap.of(path, arrays, f"{label}.") for label in labels}


def _origin(homes: Sequence[RunFolder]) -> dict[str, Any]:
    """Returns the date of the last evaluation, and the versions of packages with which runs were trained."""
    versions: dict[str, set[str]] = {}
    for path in (home.about for home in homes if home.about.is_file()):
        with naming(path):
            for name, version in read_json(path).get("versions", {}).items():
                versions.setdefault(name, set()).add(str(version))
    times = [home.metrics.stat().st_mtime for home in homes if home.metrics.is_file()]
    return {
        "date": datetime.fromtimestamp(max(times), UTC).date().isoformat(),
        "versions": {name: " or ".join(sorted(found)) for name, found in versions.items()},
    }
