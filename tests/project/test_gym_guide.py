"""The guide to gymnasium: its Python runs from top to bottom, and its table has every task."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from torchrl_her_envs import TASKS, gym_id

GUIDE = (Path(__file__).parents[2] / "docs" / "gymnasium.md").read_text()


def test_the_guide_s_python_runs_from_top_to_bottom() -> None:
    pytest.importorskip("stable_baselines3")
    blocks = re.findall(r"```python\n(.*?)```", GUIDE, re.DOTALL)
    assert len(blocks) == 4
    names: dict[str, object] = {}
    for block in blocks:
        exec(compile(block, "gymnasium.md", "exec"), names)


def test_the_guide_lists_every_task() -> None:
    for name, task in TASKS.items():
        (row,) = [line for line in GUIDE.splitlines() if line.startswith("| `") and f"`{name}`" in line]
        who, version = gym_id(task).rsplit("-", 1)
        assert f"`{who}-" in row
        assert f"-{version}`" in row
