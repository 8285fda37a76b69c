"""The page on the thesis: its names of code exist, and its table is that of the stored numbers."""

from __future__ import annotations

import importlib
import math
import re
from collections.abc import Mapping, Sequence
from types import ModuleType

import pytest

from torchrl_her_recipes.reports.results import Combination
from torchrl_her_recipes.reports.tidy import Results

from .pages import DOCS, script

PAGE = DOCS / "thesis.md"
TASK = "hand_v0"


@pytest.fixture(scope="module")
def thesis() -> ModuleType:
    pytest.importorskip("arch", reason="needs the extra report")
    return script("docs/make_thesis.py")


def study(runs: Mapping[str, Sequence[float]]) -> Results:
    """A study whose algorithms reached a success in each of their runs."""
    cells = [
        Combination(
            label=name,
            task=TASK,
            algorithm=name,
            options={},
            rows=[
                {
                    "run": run,
                    "seed": run,
                    "epoch": epoch,
                    "frames": 10 * epoch,
                    "success": success,
                    "q": success,
                }
                for epoch in (1, 2)
                for run, success in enumerate(successes)
            ],
            done=True,
            epochs=2,
            planned=len(successes),
            seconds=math.nan,
            differs="",
            goals=None,
        )
        for name, successes in runs.items()
    ]
    return Results(name="study", summary="", cells=cells)


def test_code_that_the_page_names_exists() -> None:
    names = re.findall(r"`(torchrl_her\w*(?:\.\w+)+)`", PAGE.read_text())
    assert len(set(names)) > 40
    for name in names:
        module, _, attribute = name.rpartition(".")
        assert hasattr(importlib.import_module(module), attribute), name


def test_the_table_is_of_the_numbers_that_are_stored(thesis: ModuleType) -> None:
    text, claims = PAGE.read_text(), thesis.claims()
    lines = text.split(thesis.BEGIN)[1].split(thesis.END)[0].splitlines()[2:]
    assert len(lines) == len(claims) > 30
    for line, claim in zip(lines, claims, strict=True):
        _, section, words, _, made, _, _ = (entry.strip() for entry in line.split("|"))
        assert (section, words) == (claim["section"], claim["claim"]), "run: python docs/make_thesis.py"
        assert made == thesis.made_by(claim.get("study", "")), "run: python docs/make_thesis.py"


@pytest.mark.full
def test_the_table_is_as_made_again(thesis: ModuleType) -> None:
    text = PAGE.read_text()
    assert thesis.page(text) == text, "run: python docs/make_thesis.py"


@pytest.mark.parametrize(
    ("ends", "verdict"),
    [
        ([(True, False)] * 3, "reproduced"),
        ([(True, False), (False, False)], "in part (1 of 2)"),
        ([(True, False), (False, True), (False, False)], "in part (1 of 3; 1 contradicted)"),
        ([(False, False)] * 2, "undecided"),
        ([(False, True), (False, False)], "contradicted (1 of 2)"),
        ([(False, True)], "contradicted"),
    ],
)
def test_verdicts_follow_from_intervals(
    thesis: ModuleType, ends: list[tuple[bool, bool]], verdict: str
) -> None:
    assert thesis.rule(ends) == verdict


def test_findings_compare_the_runs_of_a_study(thesis: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    found = study({"her": [0.5, 0.5, 0.5], "her_ibs": [0.75, 0.75, 0.75], "filtered_her": [0.2, 0.5, 0.8]})
    monkeypatch.setattr(thesis, "results", lambda _study: found)
    thesis.compared.cache_clear()
    find = thesis.FINDINGS
    text, verdict = find["orders"]("study", measure="success", expected=["her_ibs > her"])
    assert (text, verdict) == ("`her_ibs > her`: `hand_v0` **+25.0 (+25.0 to +25.0)**", "reproduced")
    options = {"measure": "success", "tasks": [TASK], "algorithms": ["her"]}
    assert find["levels"]("study", **options, most=0.05) == (
        "`hand_v0` `her` 50 % (50 to 50 %)",
        "contradicted",
    )
    assert find["levels"]("study", **options, least=0.4)[1] == "reproduced"
    text, verdict = find["over_training"]("study", tasks=[TASK], first="her", second="her_ibs")
    assert text == "`her` minus `her_ibs`: `hand_v0` **-25.0 (-25.0 to -25.0)**"
    assert verdict == "contradicted"
    text, verdict = find["widths"]("study", tasks=[TASK], wide="filtered_her", narrow="her")
    assert "`hand_v0` 20.4 to 0.0" in text
    assert verdict == "undecided"  # draws of three runs may all be the same one
    thesis.compared.cache_clear()


def test_evaluations_with_a_higher_median_are_counted(
    thesis: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = study({"her_a": [1, 2, 9], "filtered_her_a": [1, 1, 20], "her_b": [0], "filtered_her_b": [0]})
    monkeypatch.setattr(thesis, "results", lambda _study: found)
    text, verdict = thesis.higher_without_filter("study", measure="q", tasks=[TASK], cases=["a", "b"])
    assert text == "median higher without the filter in 2 of 2 (`a`), 0 of 2 (`b`) evaluations"
    assert verdict == "not"
