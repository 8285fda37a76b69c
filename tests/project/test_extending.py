"""The page on extending: each of its seven examples runs as it is written, from files to last line."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from importlib import invalidate_caches
from pathlib import Path

import pytest

from torchrl_her.goals.strategies import STRATEGIES
from torchrl_her_envs import registry
from torchrl_her_recipes.cli import main
from torchrl_her_recipes.config import imports
from torchrl_her_recipes.config.algorithms import ALGORITHMS
from torchrl_her_recipes.config.choices.behavior import BEHAVIOR
from torchrl_her_recipes.config.choices.learners import LEARNERS
from torchrl_her_recipes.config.choices.order import ORDER
from torchrl_her_recipes.config.choices.weights import WEIGHTS
from torchrl_her_recipes.studies import workers

from ..recipes.studies.here import Here

PAGE = (Path(__file__).parents[2] / "docs" / "extending.md").read_text()
SECTIONS = dict(re.findall(r"^## (.*?)\n(.*?)(?=^## |\Z)", PAGE, re.MULTILINE | re.DOTALL))
REGISTRIES: tuple[dict, ...] = (STRATEGIES, registry._SPECS, ALGORITHMS, LEARNERS, BEHAVIOR, WEIGHTS, ORDER)


def blocks(section: str) -> tuple[dict[str, str], list[str]]:
    """The files of a section by name, and the code that uses them."""
    files, uses = {}, []
    for block in re.findall(r"```(?:python|yaml)\n(.*?)```", SECTIONS[section], re.DOTALL):
        named = re.match(r"# (\S+\.(?:py|yaml))\n", block)
        if named:
            files[named[1]] = block
        else:
            uses.append(block)
    return files, uses


@pytest.fixture
def registered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Works in an empty folder that modules are imported from; forgets what they registered."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(imports, "_imported", [])
    before = [dict(each) for each in REGISTRIES]
    modules = set(sys.modules)
    yield
    for each, old in zip(REGISTRIES, before, strict=True):
        each.clear()
        each.update(old)
    for name in set(sys.modules) - modules:
        if getattr(sys.modules[name], "__file__", None) and str(tmp_path) in str(sys.modules[name].__file__):
            del sys.modules[name]


def test_the_page_has_seven_examples_and_names_them_all() -> None:
    assert list(SECTIONS) == [
        "A goal strategy",
        "Weights",
        "A task",
        "A learner",
        "Behavior goals",
        "An order",
        "A study",
    ]
    for section in SECTIONS:
        assert f"(#{section.lower().replace(' ', '-')})" in PAGE
        files, uses = blocks(section)
        assert files
        assert len(uses) == 1


@pytest.mark.long
@pytest.mark.usefixtures("registered")
@pytest.mark.parametrize("section", SECTIONS)
def test_an_example_runs(section: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "LocalWorkers", lambda _jobs: Here())
    files, (use,) = blocks(section)
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    invalidate_caches()
    before = [set(each) for each in REGISTRIES]
    exec(compile(use, f"extending.md: {section}", "exec"), {"__name__": "example"})
    added = [set(each) - old for each, old in zip(REGISTRIES, before, strict=True)]
    assert sum(map(len, added)) == (0 if section == "A study" else 1)


@pytest.mark.usefixtures("registered")
def test_a_learner_is_registered_without_torch(tmp_path: Path) -> None:
    for name, text in blocks("A learner")[0].items():
        (tmp_path / name).write_text(text)
    check = "import sys, plain_ddpg; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", check], check=True, capture_output=True, text=True)
    assert done.stdout == "False\n"


@pytest.mark.usefixtures("registered")
def test_the_command_of_the_page_knows_the_task(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, text in blocks("A task")[0].items():
        (tmp_path / name).write_text(text)
    invalidate_caches()
    (command,) = re.findall(r"`torchrl-her (--import point_task .*?)`", PAGE)
    assert main([*command.split(), "--show"]) == 0
    assert "name: point" in capsys.readouterr().out
