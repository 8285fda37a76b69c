"""Metrics that can be drawn over environment steps, with the label and limits of each y axis."""

from __future__ import annotations

AXES = {
    "success": ("success rate", (-0.02, 1.02)),
    "distance": ("distance to goal at the end", None),
    "q_bias": ("Q of the start minus return", None),
    "loss_value": ("loss of the critic", None),
    "rows_real_positive": ("positive rewards, real rows", None),
    "rows_useful_virtual_positive": ("positive rewards, virtual rows that count", None),
    "reached": ("goal reached at some step", (-0.02, 1.02)),
    "q": ("Q of the start", None),
    "rows_virtual_positive": ("positive rewards, virtual rows", None),
    "virtual_success": ("success rate at virtual goals", (-0.02, 1.02)),
    "virtual_q_bias": ("Q of the start minus return, virtual goals", None),
}
