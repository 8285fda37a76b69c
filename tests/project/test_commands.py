"""Commands that the documentation gives: each names options, presets, tasks and studies that there are."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

import torchrl_her_recipes
from torchrl_her_recipes import Search, cli

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "RESULTS.md", *sorted((ROOT / "docs").glob("**/*.md"))]


def commands(name: str) -> list[str]:
    """Those of one command: lines of their own, and what stands in running text."""
    text = "\n".join(page.read_text() for page in PAGES)
    lines = re.findall(rf"^(?:\$ )?torchrl-her ({name} [^#\n]*)", text, re.MULTILINE)
    inline = re.findall(rf"`torchrl-her ({name} [^`]*)`", text)
    found = {" ".join(command.split()) for command in lines + inline}
    return sorted(command for command in found if "..." not in command and "NAME" not in command)


class Reached(Exception):
    """A recipe was made of a command."""


@pytest.fixture(autouse=True)
def _nothing_is_trained(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def build(job: object) -> None:
        raise Reached

    monkeypatch.setattr(torchrl_her_recipes, "build", build)
    monkeypatch.chdir(tmp_path)
    for folder in ("docs", "benchmarks"):
        Path(folder).symlink_to(ROOT / folder)
    for page in PAGES:  # files that the commands name
        for name, text in re.findall(r"```yaml\n# (\S+\.yaml)\n(.*?)```", page.read_text(), re.DOTALL):
            Path(name).write_text(text)


@pytest.mark.parametrize("command", [own for own in commands("train") if own != "train -h"])
def test_train(command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        torchrl_her_recipes, "plan_study", lambda runs, _folder: torchrl_her_recipes.build(runs)
    )
    with pytest.raises(Reached):
        cli.main(shlex.split(command))


@pytest.mark.parametrize("command", [own for own in commands("study") if "--ray" not in own])
def test_study(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = shlex.split(command)
    code, said = cli.main([*arguments, *([] if "--plan" in arguments else ["--plan"])]), capsys.readouterr()
    if "there is no module 'panda_gym'" in said.err:  # of the extra bench
        pytest.skip("needs panda-gym")
    assert code == 0, said.err
    assert " batched runs to go, " in said.out


@pytest.mark.parametrize("command", commands("tune"))
def test_tune(command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    tried: list[Search] = []

    def tune(search: Search, *_arguments: object, **_options: object) -> None:
        tried.append(search)
        raise Reached

    monkeypatch.setattr(torchrl_her_recipes, "tune", tune)
    with pytest.raises(Reached):
        cli.main(shlex.split(command))
    assert tried[0].recipe.run.num_runs in (3, 5)


def test_there_are_commands_to_try() -> None:
    assert len(commands("tune")) > 2
    assert len(commands("train")) > 15
    assert len(commands("study")) > 8
