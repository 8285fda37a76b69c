"""How combinations of a study differ, and whether orders hold."""

from __future__ import annotations

from pathlib import Path

import pytest

from torchrl_her_recipes.config.study import Order
from torchrl_her_recipes.reports.compare import ALL_TASKS, Verdict, compare, judge
from torchrl_her_recipes.reports.results import read_combinations

from .small_study import STUDY, TASKS, write_run


def test_algorithms_at_their_end_everywhere_are_compared_on_all_tasks(tmp_path: Path) -> None:
    write_run(tmp_path, STUDY, "hand_v2_her", [0.1] * 4)
    write_run(tmp_path, STUDY, "hand_v2_filtered_her", [0.5] * 4)
    write_run(tmp_path, STUDY, "robot_v2_her", [0.3] * 4)
    write_run(tmp_path, STUDY, "robot_v2_filtered_her", [0.6] * 4)
    cells = read_combinations(STUDY, tmp_path)
    finals, gaps = compare(cells, "success", {})
    means = {(row.task, row.algorithm): row.iqm for row in finals}
    assert means[ALL_TASKS, "her"] == pytest.approx(0.2)
    assert means[ALL_TASKS, "filtered_her"] == pytest.approx(0.55)
    found = {(row.task, row.first, row.second): row.difference for row in gaps}
    assert found == {
        ("hand_v2", "filtered_her", "her"): pytest.approx(0.4),
        ("robot_v2", "filtered_her", "her"): pytest.approx(0.3),
        (ALL_TASKS, "filtered_her", "her"): pytest.approx(0.35),
    }
    orders = [Order.parse("success", text) for text in ("filtered_her > her", "filtered_her < her")]
    verdicts = {(row.task, row.order): row.verdict for row in judge(cells, orders, gaps)}
    assert [verdicts[task, orders[0].text] for task in (*TASKS, ALL_TASKS)] == [Verdict.APART] * 3
    assert [verdicts[task, orders[1].text] for task in (*TASKS, ALL_TASKS)] == [Verdict.REVERSED] * 3


def test_an_order_within_the_spread_is_undecided_and_its_sign_is_as_written(tmp_path: Path) -> None:
    write_run(tmp_path, STUDY, "hand_v2_her", [0.0, 0.4, 0.6, 1.0])
    write_run(tmp_path, STUDY, "hand_v2_filtered_her", [0.0, 0.5, 0.7, 1.0])
    cells = read_combinations(STUDY, tmp_path)
    _, gaps = compare(cells, "success", {})
    (row, *_) = judge(cells, [Order.parse("success", "her < filtered_her")], gaps)
    assert row.verdict is Verdict.UNDECIDED
    assert row.difference == pytest.approx(-0.1)
    assert row.low < 0 < row.high
