"""Numbers as a reader of a report wants them."""

from __future__ import annotations

import math

import pytest

from torchrl_her_recipes.reports.compare import Difference, Verdict
from torchrl_her_recipes.reports.formatting import SIGNS, show, show_gap, show_range


@pytest.mark.parametrize(
    ("value", "measure", "text"),
    [(0.614, "success", "61 %"), (1.0, "kl", "1.00"), (12_345.6, "rows_real_positive", "12,346")],
)
def test_each_measure_has_its_own_form(value: float, measure: str, text: str) -> None:
    assert show(value, measure) == text


def test_a_number_that_is_not_there_is_a_dash_or_nothing() -> None:
    assert show(None, "success") == show(math.nan, "kl") == "—"
    assert show_range(math.nan, math.nan, "success") == ""


def test_differences_have_a_sign_and_those_of_success_are_points() -> None:
    gap = Difference("success", "hand_v0", "her_ibs", "her", -0.0932, -0.2, 0.01, False)
    assert show_gap(gap) == "-9.3 (-20.0 to +1.0)"
    alone = Difference("rows_real_positive", "hand_v0", "her_ibs", "her", 1_234.0, math.nan, math.nan, False)
    assert show_gap(alone) == "+1,234"


def test_every_verdict_has_a_sign() -> None:
    assert set(SIGNS) == set(Verdict)
