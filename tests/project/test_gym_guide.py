"""The guide to gymnasium: its Python runs from top to bottom, and its table has every task."""

from __future__ import annotations

import pytest

from torchrl_her_envs import TASKS, gym_id

from .pages import DOCS, run_page

GUIDE = (DOCS / "gymnasium.md").read_text()


def test_the_guide_s_python_runs_from_top_to_bottom() -> None:
    pytest.importorskip("stable_baselines3")
    run_page("gymnasium.md", 4)


def test_the_guide_lists_every_task() -> None:
    for name, task in TASKS.items():
        (row,) = [line for line in GUIDE.splitlines() if line.startswith("| `") and f"`{name}`" in line]
        who, version = gym_id(task).rsplit("-", 1)
        assert f"`{who}-" in row
        assert f"-{version}`" in row
