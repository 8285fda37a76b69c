"""The pages of results: tables are those of the stored numbers."""

from __future__ import annotations

import re

from torchrl_her_recipes.reports.tidy import is_results, read_results

from .pages import DOCS, script


def test_tables_of_success_are_of_the_numbers_that_are_stored() -> None:
    """Rows with runs, frames and success are as make_results.py prints them; columns may be missing."""
    results = script("docs/make_results.py")
    stored = [
        ({name, cell.task, cell.algorithm}, results.entries(cell))
        for name in results.STUDIES
        if is_results(results.RESULTS / name)
        for cell in read_results(results.RESULTS / name).cells
        if cell.rows
    ]
    rows, outdated = 0, []
    for page in sorted((DOCS / "results").glob("*.md")):
        for line in page.read_text().splitlines():
            if (row := re.fullmatch(r"\| (.*?) \| (\d+ \| [\d,]+ \| \*\*\d+%\*\* \(.*)\|", line)) is None:
                continue
            names = {name.strip(" `") for name in row[1].split("|")}
            shown = [entry.strip() for entry in row[2].split("|")]
            rows += 1
            if not any(names <= own and shown == entries[: len(shown)] for own, entries in stored):
                outdated.append(f"{page.name}: {line}")
    assert rows > 60
    assert not outdated, "run: python docs/make_results.py"


def test_the_scoreboard_is_as_made_again() -> None:
    scoreboard = script("docs/make_scoreboard.py")
    text = scoreboard.PAGE.read_text()
    assert scoreboard.page(text) == text, "run: python docs/make_scoreboard.py"


def test_steps_to_a_level_are_those_of_each_run() -> None:
    scoreboard = script("docs/make_scoreboard.py")
    rows = [
        {"run": run, "frames": 10.0 * step, "success": success}
        for run, successes in enumerate([(0.5, 0.9, 0.8), (0.1, 0.2, 0.3)])
        for step, success in enumerate(successes)
    ]
    assert scoreboard.steps_to(rows, 0.9) == [10.0, float("inf")]
    assert scoreboard.show_steps([10.0, 20.0, float("inf")], 3000.0) == "20 (not by 3,000)"
