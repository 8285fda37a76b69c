"""Writes a page about the results of a study, with its tables and pictures."""

from __future__ import annotations

import csv
import math
import statistics
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from torchrl_her.files.writing import write_text
from torchrl_her_recipes.config.study import Study, read_orders
from torchrl_her_recipes.reports.bootstrap import REPETITIONS
from torchrl_her_recipes.reports.compare import ALL_TASKS, Difference, Final, Judged, Verdict, compare, judge
from torchrl_her_recipes.reports.formatting import MEASURES, SIGNS, show, show_gap, show_interval, show_range
from torchrl_her_recipes.reports.pictures import draw_pictures
from torchrl_her_recipes.reports.results import Combination
from torchrl_her_recipes.reports.tidy import Results, read_study
from torchrl_her_recipes.runs.plots import band
from torchrl_her_recipes.runs.scores import LAST, last_success
from torchrl_her_recipes.studies.plan import duration

_AT_THE_END = ("success", "reached", "distance", "kl", "q_bias")  # metrics whose final values are compared
_ABOUT = ("label", "task", "algorithm", "state", "runs", "epoch", "frames", "seconds", "differs")


def write_report(study: Study, folder: str | Path, out: str | Path) -> Path:
    """Writes a page about the results of a study so far, without training anything.

    Args:
        study: study that the page is about.
        folder: folder with a folder for each combination, some of which may be missing or unfinished; or
            with the files that :func:`~torchrl_her_recipes.write_results` made from these folders.
        out: folder for the page and its tables; pictures are written to its folder ``figures``.

    Returns:
        The path of the page.

    Raises:
        ValueError: the folder has none of the study's runs, or one of them cannot be read.
        OSError: the page cannot be written.
    """
    return write_page(read_study(study, Path(folder)), Path(out))


def write_page(results: Results, out: Path, *, back: str | None = None) -> Path:
    """Writes a page about given results, and returns its path; ``back`` is a page that it links to.

    See :func:`write_report` for the folder ``out``.
    """
    page = _template().render(_describe(results, out), back=back, written=f"{datetime.now():%Y-%m-%d %H:%M}")
    path = out / "index.html"
    write_text(path, page)
    return path


def _describe(results: Results, out: Path) -> dict[str, Any]:
    """Writes the tables and pictures of a page, and returns the variables of its template by name."""
    cells, orders = results.cells, read_orders(results.expect)
    measures = dict.fromkeys([*_AT_THE_END, *results.expect])
    compared = {measure: compare(cells, measure, results.published) for measure in measures}
    finals = [row for rows, _ in compared.values() for row in rows]
    differences = [row for _, rows in compared.values() for row in rows]
    judged = judge(cells, orders, differences)
    (out / "figures").mkdir(parents=True, exist_ok=True)
    _write_tables(out, cells, final=finals, differences=differences, orders=judged)
    return {
        "study": results,
        "published": results.published,
        "cells": cells,
        "averaged": _averaged(cells),
        "tasks": list(dict.fromkeys(cell.task for cell in cells)),
        "finals": {measure: rows for measure, (rows, _) in compared.items()},
        "differences": [row for row in differences if row.measure == "success"],
        "shares": _shares([row for row in finals if row.measure == "kl"]),
        "orders": _by_order(judged),
        "verdicts": Counter(row.verdict for row in judged),
        "failing": [row for row in judged if row.verdict is not Verdict.APART],
        "pictures": draw_pictures(cells, finals, out / "figures"),
        "film": results.film,
    }


def _template() -> Any:
    environment = Environment(
        loader=PackageLoader("torchrl_her_recipes"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"show": show, "show_interval": show_interval, "show_gap": show_gap}
    environment.filters |= {"duration": _duration, "success_now": _success_now}
    environment.globals["show_range"] = show_range
    environment.globals |= {"ALL_TASKS": ALL_TASKS, "MEASURES": MEASURES}
    environment.globals |= {"REPETITIONS": REPETITIONS, "SIGNS": SIGNS}
    return environment.get_template("report.html")


def _duration(seconds: float) -> str:
    return "—" if math.isnan(seconds) else duration(seconds)


def _success_now(cell: Combination) -> str:
    """Formats the median success of a combination's runs in their last evaluation."""
    return show(statistics.median(last_success(cell.rows)), "success")


def _averaged(cells: Sequence[Combination]) -> str:
    """Describes over how many of the last evaluations results are averaged, which short runs limit."""
    counts = [min(LAST, len({row["epoch"] for row in cell.rows})) for cell in cells if not cell.missing]
    least, most = min(counts), max(counts)
    if most == 1:
        return "last evaluation"
    return f"last {most} evaluations" if least == most else f"last {least} to {most} evaluations"


def _shares(rows: Sequence[Final]) -> dict[tuple[str, str], tuple[float, float | None]]:
    """Returns, by task and algorithm, the divergence as a fraction of HER's: measured and published."""
    her = {row.task: row for row in rows if row.algorithm == "her" and row.iqm > 0}
    shares = {}
    for row in rows:
        base = her.get(row.task)
        if base is not None and base is not row:
            ratio = row.published / base.published if row.published is not None and base.published else None
            shares[row.task, row.algorithm] = (row.iqm / base.iqm, ratio)
    return shares


def _by_order(judged: Sequence[Judged]) -> dict[tuple[str, str], dict[str, Judged]]:
    """Arranges judged orders as a table: by metric and order, and then by task."""
    table: dict[tuple[str, str], dict[str, Judged]] = {}
    for row in judged:
        table.setdefault((row.measure, row.order), {})[row.task] = row
    return table


def _write_tables(
    out: Path, cells: Sequence[Combination], **compared: Sequence[Final | Difference | Judged]
) -> None:
    """Writes the tables of runs and curves, and for each name in ``compared`` a table of its rows."""
    tables: dict[str, list[dict[str, Any]]] = {
        "runs": [{name: getattr(cell, name) for name in _ABOUT} for cell in cells],
        "curves": [point for cell in cells for point in _points(cell)],
        **{name: [asdict(row) for row in rows] for name, rows in compared.items()},
    }
    for name, rows in tables.items():
        with open(out / f"{name}.csv", "w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerows([rows[0].keys()] if rows else [])
            writer.writerows([_cell(value) for value in row.values()] for row in rows)


def _cell(value: object) -> object:
    return f"{value:.6g}" if isinstance(value, float) else value


def _points(cell: Combination) -> list[dict[str, Any]]:
    """Returns a combination's rows in the table of curves: percentiles of each metric by frames."""
    names = ("frames", "percentile_33", "median", "percentile_67")
    return [
        {"task": cell.task, "algorithm": cell.algorithm, "measure": measure}
        | dict(zip(names, map(float, point), strict=True))
        for measure in (*MEASURES, "q", "return")
        if cell.has(measure)
        for point in zip(*band(cell.rows, measure), strict=True)
    ]
