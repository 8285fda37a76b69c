"""The page that shows the tables."""

from __future__ import annotations

from .page import PAGE, page
from .tables import REFUSALS


def test_the_page_shows_the_tables_that_the_tests_hold() -> None:
    made = "python -m tests.torchrl_her.compatibility.page"
    assert PAGE.read_text() == page(), f"docs/compatibility.md is not what the tables say: run {made}"


def test_each_refusal_is_in_use() -> None:
    shown = page()
    assert [name for name, refusal in REFUSALS.items() if refusal.says not in shown] == []
