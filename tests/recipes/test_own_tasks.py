"""Environments of users: trained, filmed, played and resumed by name, and imported only if they say so."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import pytest
import yaml

from torchrl_her_recipes import (
    RunFolder,
    Search,
    Study,
    allow_imports,
    build,
    export_policy,
    load_policy,
    load_space,
    make_recipe,
    play,
    resume,
    run,
    run_study,
    tune,
)
from torchrl_her_recipes.cli import main
from torchrl_her_recipes.config import imports
from torchrl_her_recipes.config.imports import check_permitted, permit_task
from torchrl_her_recipes.runs.folder import is_own, remember

from .foreign_task import write_module
from .small import Refused, overrides, small

TINY: dict[str, Any] = {"epochs": 1, "epoch_frames": 320, "num_envs": 4, "warmup_frames": 80, "episodes": 3}
REFUSED = "would import the module '{}', which a file names and not you: if you trust it, give --allow-import"


@pytest.fixture
def stranger(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """The task of a module in the current folder, which nobody has permitted yet."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setattr(imports, "_permitted", set())
    name = f"maze_of_{tmp_path.name.replace('-', '_')}"
    task = write_module(tmp_path, name)
    yield task
    unload(task)


def forget(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a new process."""
    monkeypatch.setattr(imports, "_permitted", set())


def unload(task: str) -> None:
    sys.modules.pop(module_of(task), None)
    gymnasium.registry.pop("Maze-v0", None)


def module_of(task: str) -> str:
    return task.split(":")[1]


@pytest.mark.long
def test_an_environment_of_one_s_own_end_to_end(
    stranger: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    refused: Refused,
) -> None:
    """Trained because it was typed; everything that reads the folder for somebody else asks."""
    assert main(["train", *overrides(task=stranger, folder="run", pictures=True, **TINY)]) == 0
    assert "has no compute_terminated" in capsys.readouterr().err
    assert Path("run/policy.gif").stat().st_size > 500
    module, said = module_of(stranger), REFUSED.format(module_of(stranger))
    unload(stranger)
    forget(monkeypatch)
    assert main(["play", "run", "--goals", "2"]) == 0  # this user has trained it
    assert "of 2 goals achieved: run/play.gif" in capsys.readouterr().out
    Path("run/play.gif").unlink()
    unload(stranger)
    forget(monkeypatch)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "of_somebody_else"))
    for command in (["play", "run"], ["export", "run"], ["train", "--resume", "run"]):
        assert said in refused(*command)
        assert module not in sys.modules
    recipe = RunFolder("run").recipe()
    for call in (
        partial(build, recipe),
        partial(resume, "run", progress=False),
        partial(load_policy, "run"),
        partial(export_policy, "run", "out.safetensors"),
        partial(play, "run", out="out.gif"),
        partial(run_study, Study(name="theirs", vary={"task": [stranger]}), Path("study"), progress=False),
        partial(tune, Search(recipe=recipe, space=load_space("ddpg")), "search", trials=1),
    ):
        with pytest.raises(ValueError, match=said):
            call()
        assert module not in sys.modules
    assert main(["play", "run", "--goals", "2", "--allow-import"]) == 0
    assert "of 2 goals achieved: run/play.gif" in capsys.readouterr().out
    with pytest.raises(ValueError, match=said):  # the permission ended with its command
        check_permitted(stranger)
    with allow_imports():
        policy = export_policy("run", "maze.safetensors")
    assert 0.0 <= policy.info.success < 1.0  # goals that are missed give 0, which is no success
    forget(monkeypatch)
    assert load_policy("maze.safetensors").in_keys == ["observation", "desired_goal"]
    assert load_policy("maze.safetensors").info.task == stranger
    assert imports._permitted == set()


def test_a_run_that_was_moved_or_changed_is_nobody_s_own(tmp_path: Path) -> None:
    config = tmp_path / "run" / "config.yaml"
    config.parent.mkdir()
    config.write_text("task: {name: 'mine:make'}")
    assert not is_own(config)
    remember(config, "hand_v1")  # names no module
    assert not is_own(config)
    remember(config, "mine:make")
    assert is_own(config)
    moved = config.parent.rename(tmp_path / "moved") / "config.yaml"
    assert not is_own(moved)
    remember(moved, "mine:make")
    moved.write_text("task: {name: 'theirs:make'}")
    assert not is_own(moved)


def test_presets_and_studies_are_files_of_somebody_too(stranger: str, refused: Refused) -> None:
    Path("theirs.yaml").write_text(yaml.safe_dump({"task": stranger}))
    Path("study.yaml").write_text(yaml.safe_dump({"vary": {"task": [stranger], "algo": ["her"]}}))
    for command in (["train", "preset=theirs.yaml"], ["study", "study.yaml"]):
        assert REFUSED.format(module_of(stranger)) in refused(*command)
    assert module_of(stranger) not in sys.modules


def test_who_names_a_module_has_permitted_it(stranger: str) -> None:
    for recipe in (make_recipe({"task": stranger}), small().replace(task=stranger)):
        with pytest.raises(ValueError, match=REFUSED.format(module_of(stranger))):
            build(recipe)
    make_recipe(task=stranger)
    check_permitted(stranger)


def test_import_on_the_command_line_permits_a_module_and_what_is_in_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(imports, "_imported", ["mine"])
    monkeypatch.setattr(imports, "_permitted", set())  # whatever other tests have asked for
    for task in ("mine:make", "mine.parts:make", "gym:mine:My-v0", "gym:FetchReach-v4", "hand_v0"):
        check_permitted(task)
    for task in ("mined:make", "gym:other:My-v0", "gymnasium:make", "torchrl_her_envs.registry:make_env"):
        with pytest.raises(ValueError, match="would import the module"):
            check_permitted(task)
    check_permitted("gym:gymnasium_robotics:FetchReach-v4")
    with allow_imports():
        check_permitted("mined:make")
    permit_task("mined:make")
    check_permitted("mined:make")


@pytest.mark.parametrize(
    "task", ["gym:torchrl_her_envs:torchrl_her/HandReach-v0", "tests.envs.common.own_point:Point"]
)
def test_environments_that_end_by_themselves_work_with_a_curriculum(task: str) -> None:
    """Their own goals are easy to meet by chance, and those of the first stage are not."""
    width = 2 if "Point" in task else 5
    seen = {"observation": list(range(width)), "achieved_goal": [0, 1], "desired_goal": [width, width + 1]}
    stages = [{**seen, "name": "near", "threshold": 1e-6}, {**seen, "name": "task"}]
    easy: dict[str, Any] = {} if "Point" in task else {"task.options": {"threshold": 0.5}}
    recipe = make_recipe(small(**TINY).to_dict(), task=task, algo="cher", curriculum=stages, **easy)
    components = build(recipe)
    rows = run(components, progress=False).rows
    assert rows[-1]["stage_success"] == 0.0
    lengths = components.env.rollout(30, break_when_any_done=False)["next"]
    ended = lengths["truncated"] & ~lengths["terminated"]
    assert ended.any()
    assert not lengths["terminated"].any()
    assert (lengths["reward"] == -1).all()
