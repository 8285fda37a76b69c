"""``docs/interface.md`` lists the fronts of the packages, and names that have left them still work."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import pytest

import torchrl_her

TEXT = (Path(__file__).parents[2] / "docs" / "interface.md").read_text()
MOVED = {
    name: home
    for names, home in re.findall(r"^\| (`.+`) \| `([\w.]+)` \|$", TEXT, re.MULTILINE)
    for name in re.findall(r"`(\w+)`", names)
}


@pytest.mark.parametrize("package", ["torchrl_her", "torchrl_her_envs", "torchrl_her_recipes"])
def test_the_stable_names_are_those_of_the_front(package: str) -> None:
    (names,) = re.findall(rf"^### {package}\n\n((?:.+\n)+)", TEXT, re.MULTILINE)
    assert re.findall(r"`(\w+)`", names) == importlib.import_module(package).__all__


def test_names_that_left_the_front_work_with_a_warning_that_says_where_they_are() -> None:
    assert len(MOVED) > 0
    for name, home in MOVED.items():
        assert name not in torchrl_her.__all__
        with pytest.warns(DeprecationWarning, match=f"^{name} is in {home}; ") as caught:
            found = getattr(torchrl_her, name)
        assert found is getattr(importlib.import_module(home), name)
        assert caught[0].filename == __file__  # the line that has to change
    with pytest.raises(AttributeError, match="has no attribute 'make_nothing'"):
        torchrl_her.make_nothing  # noqa: B018


def test_the_page_lists_all_names_that_left_the_front() -> None:
    assert {name: home.removeprefix("torchrl_her.") for name, home in MOVED.items()} == torchrl_her._MOVED
