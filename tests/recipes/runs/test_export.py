"""Runs of every learner, exported as ONNX and played from there."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from torchrl_her import load_checkpoint, save_checkpoint
from torchrl_her_envs import make_env
from torchrl_her_recipes import (
    build,
    export_policy,
    load_actor,
    load_policy,
    load_trained,
    read_card,
    run,
)
from torchrl_her_recipes.cli import main
from torchrl_her_recipes.components.curricula import make_played_env

from ..small import small
from .exported.tiny import needs_onnx


@needs_onnx
@pytest.mark.parametrize(
    "options",
    [
        {"algo": "cher", "normalize": True, "num_runs": 2},
        pytest.param({"algo": "her", "learner": "td3"}, marks=pytest.mark.full),
        {"algo": "filtered_her", "learner": "sac", "normalize": True},
        pytest.param({"algo": "cher", "learner": "tqc"}, marks=pytest.mark.full),
        {"algo": "her", "task": "bit_flip"},
    ],
    ids=lambda options: f"{options['algo']}_{options.get('learner', options.get('task', 'ddpg'))}",
)
def test_a_run_acts_the_same_in_each_format(options: dict[str, Any], tmp_path: Path) -> None:
    """A curriculum's network reads a padded input; its exported policy reads what the task shows."""
    recipe = small(**{"task": "hand_v1", "epochs": 1, "hidden": 8, **options})
    components = build(recipe)
    run(components, tmp_path / "run", progress=False)
    last = recipe.run.num_runs - 1
    as_onnx = export_policy(tmp_path / "run", tmp_path / "mine.onnx", run=last)
    as_torch = export_policy(tmp_path / "run", tmp_path / "mine.pt", run=last)
    assert (
        as_onnx.card == as_torch.card == read_card(tmp_path / "mine.onnx") == read_card(tmp_path / "mine.pt")
    )
    assert as_torch.card.seed == last
    assert as_torch.card.frames == 1_600
    assert set(as_torch.card.versions) == {"torchrl-her", "torch", "torchrl", "tensordict"}
    seen = make_env(recipe.task.name, num_envs=9, seed=7).reset()
    shown = make_played_env(recipe, 9, [7]).reset()
    with torch.no_grad():
        own = load_actor(tmp_path / "run", run=last)(shown)["action"]
    for file, tolerance in (("mine.pt", 2e-6), ("mine.onnx", 1e-5)):
        action = load_policy(tmp_path / file)(seen.clone())["action"]
        torch.testing.assert_close(action, own, atol=tolerance, rtol=0)


@needs_onnx
def test_on_the_command_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["export", "hand_reach", "--format", "onnx"]) == 0
    assert capsys.readouterr().out == "seed 1, success 100% on hand_reach: hand_reach.onnx\n"
    assert "`hand_reach`" in Path("hand_reach.md").read_text()
    assert load_trained("hand_reach.onnx").recipe == load_trained("hand_reach").recipe
    command = ["--goals", "2", "--size", "64", "--seed", "3"]
    assert main(["play", "hand_reach.onnx", *command]) == 0
    assert capsys.readouterr().out == "2 of 2 goals achieved: hand_reach.gif\n"
    assert main(["export", "hand_reach", "--out", "other.pt", "--no-card"]) == 0
    assert not Path("other.md").exists()
    assert read_card("other.pt").success == 1.0
    capsys.readouterr()
    for wrong, message in (
        (["hand_reach.onnx", "--out", "new.pt"], "its weights are part of a graph; export the .pt file"),
        (["other.pt"], "other.pt would be replaced by itself: give --out or --format onnx"),
        (
            ["other.pt", "--out", "a.pt", "--run", "1"],
            "run=1 has no effect with other.pt, which holds a single",
        ),
        (
            ["other.pt", "--out", "a.pt", "--format", "onnx"],
            "format=onnx must have the suffix .onnx, got 'a.pt'",
        ),
        (["other.pt", "--out", "a.onnx", "--task", "robot_v0"], "observation [5], desired_goal [2] and"),
        (["nowhere"], "nowhere is no folder of a run: it has no config.yaml; nor is it the file"),
    ):
        assert main(["export", *wrong]) == 2
        said = capsys.readouterr().err
        assert message in said
        assert said.count("\n") == 1
    Path("a.md").write_text("mine")
    assert main(["export", "other.pt", "--out", "a.onnx"]) == 2
    assert "a.md exists and is no model card that export wrote" in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "a.md", "hand_reach.gif", "hand_reach.md", "hand_reach.onnx", "other.pt"
    ]  # fmt: skip
    Path("bad.onnx").write_bytes(Path("hand_reach.onnx").read_bytes()[:-100])
    for command in (["play", "bad.onnx"], ["record", "hand_reach", "--policy", "bad.onnx"]):
        assert main(command) == 2
        said = capsys.readouterr().err
        assert said.startswith("torchrl-her: bad.onnx is ")
        assert said.count("\n") == 1


@pytest.mark.parametrize("missing", ["onnx", "onnxruntime", "onnxscript"])
def test_without_the_extra_nothing_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], missing: str
) -> None:
    monkeypatch.setitem(sys.modules, missing, None)
    assert main(["export", "hand_reach", "--out", str(tmp_path / "a.onnx")]) == 2
    said = capsys.readouterr().err
    assert said == "torchrl-her: ONNX files need onnx, onnxruntime and onnxscript: pip install '.[onnx]'\n"
    assert list(tmp_path.iterdir()) == []


def _wide(state: dict[str, Any]) -> None:
    state["recipe"]["learner"]["hidden"] = 10_000_000


def _claims_much(state: dict[str, Any]) -> None:
    state["recipe"]["learner"]["hidden"] = 2_000
    state["actor"] = {
        name: torch.zeros(()).expand([2_000 if side == 64 else side for side in value.shape])
        for name, value in state["actor"].items()
    }


def _no_widths(state: dict[str, Any]) -> None:
    del state["card"]["widths"]


def _other_learner(state: dict[str, Any]) -> None:
    state["recipe"]["learner"]["name"] = "theirs"


def _no_weights(state: dict[str, Any]) -> None:
    state["actor"] = [1, 2]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_wide, "must be (1, 7, 10000000), got (1, 7, 64)"),
        (_claims_much, "weights must have a place for each of their numbers"),
        (_no_widths, "a policy's card lacks widths"),
        (_other_learner, "unknown learner 'theirs'"),
        (_no_weights, "bad.pt is no exported policy: "),
    ],
)
def test_files_that_somebody_made_give_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    change: Callable[[dict[str, Any]], None],
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    export_policy("hand_reach", "good.pt", card=False)
    state = load_checkpoint("good.pt")
    change(state)
    save_checkpoint(state, "bad.pt")
    assert main(["play", "bad.pt"]) == 2
    said = capsys.readouterr().err
    assert said.startswith("torchrl-her: bad.pt is no exported policy: ")
    assert message in said
    assert said.count("\n") == 1


def test_a_policy_that_no_longer_fits_its_task_is_not_played(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    players = sys.modules["torchrl_her_recipes.runs.players"]

    robot = make_env("robot_v0", num_envs=2)
    monkeypatch.setattr(players, "make_task_envs", lambda *_args, **_options: robot)
    assert main(["play", "hand_reach", "--out", str(tmp_path / "a.gif")]) == 2
    assert "a policy of hand_reach cannot play hand_reach: it has other widths" in capsys.readouterr().err
