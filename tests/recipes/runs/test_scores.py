"""The best policy of a run: which one it is, that it stays so when the run goes on, and how it is used."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from torchrl_her_recipes import Callback, RunView, build, export_policy, load_policy, play, resume, run
from torchrl_her_recipes.cli import main
from torchrl_her_recipes.config.policy_header import read_header
from torchrl_her_recipes.runs import run as running
from torchrl_her_recipes.runs.policy_file import read_policy

from ..small import Refused, assert_same, small

SHORT: dict[str, Any] = {"seed": 3}


@pytest.fixture
def says(monkeypatch: pytest.MonkeyPatch) -> dict[int, list[float]]:
    """The success of each run by epoch, which evaluations are made to find."""
    found: dict[int, list[float]] = {}
    measure = running.measure

    def measured(components: Any, rollout: Any) -> dict[str, torch.Tensor]:
        epoch = int(next(epochs))
        return measure(components, rollout) | {"success": torch.tensor(found[epoch])}

    epochs = iter(range(1, 100))
    monkeypatch.setattr(running, "measure", measured)
    return found


class Weights(Callback):
    """Keeps the greedy policy of each epoch, and how often the best one was written before."""

    def __init__(self) -> None:
        self.actors: dict[int, dict[str, torch.Tensor]] = {}
        self.written: list[int] = []

    def on_epoch(self, run: RunView) -> None:
        own = {name: value.clone() for name, value in run.components.greedy.state_dict().items()}
        self.actors[run.trainer.epochs] = own
        if run.folder.best.exists():
            self.written.append(int(read_header(run.folder.best)["epoch"]))


def test_the_best_evaluation_is_kept_and_the_later_of_two_equal_ones(
    says: dict[int, list[float]], tmp_path: Path
) -> None:
    says |= {1: [0.25], 2: [0.75], 3: [0.75], 4: [0.5]}
    weights = Weights()
    run(build(small(epochs=4, **SHORT)), tmp_path, callbacks=[weights], progress=False)
    best, actor = read_policy(tmp_path / "best.safetensors")
    assert (best["epoch"], best["success"]) == (3, 0.75)
    assert_same(actor, weights.actors[3])
    assert not all(torch.equal(actor[name], value) for name, value in weights.actors[4].items())
    assert weights.written == [1, 2, 3]  # as seen one epoch later: the fourth one wrote nothing
    assert json.loads((tmp_path / "run.json").read_text())["best"] == {"epoch": 3, "success": 0.75}


def test_runs_side_by_side_are_kept_as_of_the_evaluation_with_the_best_median(
    says: dict[int, list[float]], tmp_path: Path
) -> None:
    says |= {1: [0.5, 0.5, 0.5], 2: [1.0, 0.25, 0.25], 3: [0.25, 0.25, 0.25]}
    weights = Weights()
    run(build(small(epochs=3, num_runs=3, **SHORT)), tmp_path, callbacks=[weights], progress=False)
    best, actor = read_policy(tmp_path / "best.safetensors")
    assert (best["epoch"], best["success"]) == (1, 0.5)
    assert_same(actor, weights.actors[1])
    first, third = load_policy(tmp_path, run=0, best=True), load_policy(tmp_path, run=2, best=True)
    assert not all(torch.equal(value, third.state_dict()[name]) for name, value in first.state_dict().items())


def test_a_run_that_goes_on_remembers_its_best_policy(says: dict[int, list[float]], tmp_path: Path) -> None:
    class Stop(Callback):
        def on_epoch(self, run: RunView) -> bool:
            return run.trainer.epochs == 2

    says |= {1: [0.75], 2: [0.5], 3: [0.5]}
    weights = Weights()
    run(build(small(epochs=3, **SHORT)), tmp_path, callbacks=[weights, Stop()], progress=False)
    (tmp_path / "best.safetensors").unlink()  # as if it had been lost: it is in the checkpoint
    resume(tmp_path, options={"checkpoint_interval": 2}, progress=False)
    best, actor = read_policy(tmp_path / "best.safetensors")
    assert best["epoch"] == 1
    assert_same(actor, weights.actors[1])
    assert json.loads((tmp_path / "run.json").read_text())["best"]["epoch"] == 1


def test_a_best_policy_that_is_newer_than_the_checkpoint_does_not_survive_it(
    says: dict[int, list[float]], tmp_path: Path
) -> None:
    class Fail(Callback):
        def on_batch(self, run: RunView) -> None:
            if run.trainer.epochs == 2:
                raise RuntimeError("killed")

    says |= {1: [0.25], 2: [1.0], 3: [0.5], 4: [0.5]}  # what is done again comes out worse
    recipe = small(epochs=2, checkpoint_interval=5, **SHORT)
    with pytest.raises(RuntimeError, match="killed"):
        run(build(recipe.replace(epochs=3)), tmp_path, callbacks=[Fail()], progress=False)
    assert read_header(tmp_path / "best.safetensors")["epoch"] == 2
    resume(tmp_path, options={"epochs": 2}, progress=False)
    assert read_header(tmp_path / "best.safetensors")["epoch"] == 2
    assert read_header(tmp_path / "best.safetensors")["success"] == 0.5


@pytest.fixture
def two(says: dict[int, list[float]], tmp_path: Path) -> Path:
    """The folder of a run whose first epoch was better than its second one."""
    says |= {1: [0.75, 0.5, 1.0], 2: [0.5, 0.25, 0.75]}
    folder = tmp_path / "two"
    run(build(small(num_runs=3, task="hand_v0", **SHORT)), folder, progress=False)
    return folder


def test_the_best_policy_is_played_loaded_and_exported(
    two: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert read_header(two / "best.safetensors")["epoch"] == 1
    last, best = load_policy(two, run=1), load_policy(two, run=1, best=True)
    assert_same(dict(best.state_dict()), dict(load_policy(two / "best.safetensors", run=1).state_dict()))
    assert not all(torch.equal(value, last.state_dict()[name]) for name, value in best.state_dict().items())

    written = export_policy(two, tmp_path / "best_1.safetensors", run=1, best=True)
    assert written.info.frames == 480
    for own in (
        load_policy(tmp_path / "best_1.safetensors"),
        load_policy(two / "best.safetensors", run=1),
        best,
    ):
        assert_same(dict(own.state_dict()), dict(written.state_dict()))
    assert export_policy(two, tmp_path / "last.safetensors").info.frames == 960

    options = ["--goals", "2", "--size", "64"]
    films = {name: tmp_path / f"{name}.gif" for name in ("flag", "file", "last")}
    assert main(["play", str(two), "--best", "--out", str(films["flag"]), *options]) == 0
    assert main(["play", str(two / "best.safetensors"), "--out", str(films["file"]), *options]) == 0
    assert main(["play", str(two), "--out", str(films["last"]), *options]) == 0
    assert films["flag"].read_bytes() == films["file"].read_bytes() != films["last"].read_bytes()
    assert main(["export", str(two), "--best", "--out", str(tmp_path / "mine.safetensors")]) == 0
    assert capsys.readouterr().out.splitlines()[-1].startswith("seed 3, success ")  # the median of epoch 1


def test_without_a_best_policy_one_line_says_so(two: Path, tmp_path: Path, refused: Refused) -> None:
    with pytest.raises(ValueError, match="best needs the folder of a run, got hand_v1"):
        play("hand_v1", out=tmp_path / "film.gif", best=True)
    (two / "best.safetensors").unlink()
    said = f"torchrl-her: {two} has no best.safetensors: the run has not been evaluated yet"
    for command in ("play", "export"):
        assert refused(command, str(two), "--best").startswith(said)
