"""What the thesis says of a study."""

from __future__ import annotations

import pytest

from torchrl_her_recipes.config.study import load_study, study_names
from torchrl_her_recipes.reports.thesis import Order, load_thesis

CHAPTERS = ("ibs", "bias", "curriculum", "window", "initialisation")


def test_no_study_of_the_thesis_is_left_out() -> None:
    assert {name for name in study_names() if load_thesis(name).orders} >= set(CHAPTERS)


@pytest.mark.parametrize("name", CHAPTERS)
def test_what_the_thesis_says_is_about_what_the_study_has(name: str) -> None:
    thesis, cells = load_thesis(name), list(load_study(name).cells())
    tasks = {recipe.task.name for _, recipe in cells}
    assert thesis.orders
    assert {task for own in thesis.numbers.values() for task in own} <= tasks
    labels = {label.removeprefix(f"{recipe.task.name}_") for label, recipe in cells}
    assert any({order.more, order.less} <= labels for order in thesis.orders)
    assert {order.measure for order in thesis.orders} | set(thesis.numbers) <= set(thesis.where) | {"kl"}


def test_an_order_is_written_in_one_of_two_ways() -> None:
    with pytest.raises(ValueError, match="'a > b' or 'a < b', got 'her = cher'"):
        Order.parse("success", "her = cher")
