"""Formats names of metrics, numbers and intervals for the page of a report."""

from __future__ import annotations

import math

from torchrl_her_recipes.reports.compare import Difference, Final, Judged, Verdict

MEASURES = {  # for each metric, its name on the page
    "success": "success",
    "reached": "goal reached at some step",
    "distance": "distance to goal",
    "kl": "KL(q, q*)",
    "q_bias": "bias of Q",
    "rows_real_positive": "positive rewards, real rows",
    "rows_virtual_positive": "positive rewards, virtual rows",
    "rows_useful_virtual_positive": "positive rewards, virtual rows that count",
}

SIGNS = {  # for each verdict, its sign on the page and the CSS class of the sign
    Verdict.APART: ("✓", "good"),
    Verdict.HOLDS: ("(✓)", "good"),
    Verdict.UNDECIDED: ("?", "fair"),
    Verdict.REVERSED: ("✗", "bad"),
    Verdict.OPEN: ("…", "fair"),
}


def show(value: float | None, measure: str) -> str:
    """Formats the value of a metric; returns a dash if the value is None or NaN.

    Example:
        >>> show(0.614, "success"), show(1.0, "kl"), show(12345.6, "rows_real_positive"), show(None, "kl")
        ('61 %', '1.00', '12,346', '—')
    """
    if value is None or math.isnan(value):
        return "—"
    if measure in ("success", "reached", "share"):
        return f"{value:.0%}".replace("%", " %")
    return f"{value:,.0f}" if measure.startswith("rows_") else f"{value:.2f}"


def show_interval(row: Final, measure: str) -> str:
    """Formats an interquartile mean, followed by its interval in brackets."""
    return show(row.iqm, measure) + show_range(row.low, row.high, measure)


def show_range(low: float, high: float, measure: str) -> str:
    """Formats the ends of an interval in brackets; returns an empty text if they are NaN.

    Example:
        >>> show_range(0.27, 0.45, "success")
        ' (27 to 45 %)'
    """
    if math.isnan(low):
        return ""
    return f" ({show(low, measure).removesuffix(' %')} to {show(high, measure)})"


def show_gap(row: Difference | Judged) -> str:
    """Formats a difference and its interval with signs; differences of success are in percentage points.

    Example:
        >>> show_gap(Difference("success", "hand_v0", "her_ibs", "her", 0.0932, 0.01, 0.2, False))
        '+9.3 (+1.0 to +20.0)'
    """
    if math.isnan(row.difference):
        return "—"
    scale, form = {"success": (100, "+.1f")}.get(row.measure, (1, "+.2f"))
    if row.measure.startswith("rows_"):
        form = "+,.0f"
    value, low, high = (f"{scale * number:{form}}" for number in (row.difference, row.low, row.high))
    return value if math.isnan(row.low) else f"{value} ({low} to {high})"
