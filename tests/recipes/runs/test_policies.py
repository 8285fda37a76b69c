"""Policies as files: exported from runs, and those that come with the package."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from torchrl_her import evaluate, load_checkpoint, save_checkpoint, success
from torchrl_her_envs import TASKS, make_env
from torchrl_her_recipes import build, export_policy, load_actor, load_policy, load_trained, run
from torchrl_her_recipes.cli import main
from torchrl_her_recipes.components.curricula import make_played_env
from torchrl_her_recipes.config.shipped import policy_names

from ..small import small


def backwards() -> list[dict[str, Any]]:
    """A layer of hand_v1 that sees its observation from the end, and not all of it."""
    (*_, last) = make_env("hand_v1", num_envs=1).layers()
    observation = last["observation"][:0:-1]
    return [last | {"observation": observation}]


@pytest.mark.parametrize(
    "options",
    [
        {"algo": "filtered_her"},
        {"algo": "cher"},
        {"algo": "her", "normalize": True},
        {"algo": "cher", "normalize": True},
        {"algo": "cher", "curriculum": backwards()},
        {"algo": "cher", "curriculum": backwards(), "normalize": True},
    ],
    ids=lambda options: "_".join(options),
)
def test_an_exported_policy_acts_as_its_run_does(options: dict[str, Any], tmp_path: Path) -> None:
    recipe = small(task="hand_v1", num_runs=2, epochs=1, **options)
    components = build(recipe)
    run(components, tmp_path / "run", progress=False)
    written = export_policy(tmp_path / "run", tmp_path / "policy.pt", run=1)
    assert written.recipe.run.seed == 1
    assert written.frames == 1_600
    seen = make_env("hand_v1", num_envs=4, seed=7).reset()
    shown = make_played_env(recipe, 4, [7]).reset()
    own = load_actor(tmp_path / "run", run=1)(shown)["action"]
    torch.testing.assert_close(load_policy(tmp_path / "policy.pt")(seen)["action"], own)
    played = components.greedy(torch.cat((shown, shown)))["action"]  # of two runs
    torch.testing.assert_close(played[4:], own)


def test_export_takes_the_median_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "run"
    run(build(small(num_runs=3, epochs=1)), folder, progress=False)
    lines = (folder / "metrics.csv").read_text().splitlines()
    place = lines[0].split(",").index("success")
    for index, value in enumerate(("0.5", "0.9", "0.1")):
        cells = lines[index + 1].split(",")
        cells[place] = value
        lines[index + 1] = ",".join(cells)
    (folder / "metrics.csv").write_text("\n".join(lines) + "\n")
    assert main(["export", str(folder)]) == 0
    said = capsys.readouterr().out
    assert said.startswith("seed 0, success ")
    assert said.endswith(f" on hand_v0: {folder / 'hand_v0.pt'}\n")


def test_what_cannot_be_exported_is_said(tmp_path: Path) -> None:
    other = tmp_path / "other"
    run(build(small(task="hand_v0", epochs=1)), other, progress=False)
    with pytest.raises(ValueError, match="a policy of hand_v0 cannot play robot_v0: it has other widths"):
        export_policy(other, tmp_path / "policy.pt", task="robot_v0")
    with pytest.raises(ValueError, match="unknown task 'nope'"):
        export_policy(other, tmp_path / "policy.pt", task="nope")
    with pytest.raises(ValueError, match="there is no run 4 in .*; it has runs 0 to 0"):
        export_policy(other, tmp_path / "policy.pt", run=4)
    state = load_checkpoint(other / "policy.pt")
    save_checkpoint({"actor": {"own": state["actor"].popitem()[1]}}, other / "policy.pt")
    with pytest.raises(ValueError, match="a policy of learner=auto in .* cannot be exported: these are not"):
        export_policy(other, tmp_path / "policy.pt")
    assert list(tmp_path.iterdir()) == [other]
    with pytest.raises(ValueError, match="there is no policy 'hand_v9'; there are hand_reach"):
        load_policy("hand_v9")


def test_every_task_has_a_trained_policy() -> None:
    assert policy_names() == sorted(TASKS)


@pytest.mark.parametrize("task", TASKS)
def test_trained_policies_are_as_good_as_they_say(task: str) -> None:
    """300 other episodes; five standard deviations of room."""
    trained = load_trained(task)
    assert trained.task == task
    env = make_env(task, num_envs=300, seed=99)
    measured = float(success(evaluate(env, trained.actor, max_steps=env.max_steps)).float().mean())
    assert measured > trained.success - 5 * 0.029
    assert measured > 0.3


def test_a_task_is_played_at_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "hand_v1.gif"
    assert main(["play", "hand_v1", "--out", str(out), "--goals", "2", "--size", "64"]) == 0
    assert out.stat().st_size > 1_000
    assert "of 2 goals achieved" in capsys.readouterr().out
    assert main(["play", "hand_v9"]) == 2
    assert "nor the file of an exported policy, nor one of the trained policies" in capsys.readouterr().err


def test_what_export_wrote_is_played(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    run(build(small(task="hand_v0", epochs=1, pictures=True)), "run", progress=False)
    assert main(["export", "run", "--out", "mine.pt"]) == 0
    assert main(["play", "mine.pt", "--goals", "2", "--size", "64", "--seed", "3"]) == 0
    alone = capsys.readouterr().out.splitlines()[-1]
    assert alone.endswith(" of 2 goals achieved: mine.gif")
    assert main(["play", "run", "--goals", "2", "--size", "64", "--seed", "3"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == alone.replace("mine.gif", "run/play.gif")
    assert Path("mine.gif").read_bytes() == Path("run/play.gif").read_bytes()
    filmed = Path("run/policy.gif").read_bytes()
    assert main(["play", "run/policy.pt", "--goals", "2", "--size", "64", "--seed", "3"]) == 0
    assert Path("mine.gif").read_bytes() == Path("run/play.gif").read_bytes()
    assert Path("run/policy.gif").read_bytes() == filmed
    assert main(["play", "run/checkpoint.pt"]) == 2
    said = "torchrl-her: run/checkpoint.pt is no exported policy: `torchrl-her export RUN`"
    assert said in capsys.readouterr().err
    Path("notes.txt").write_text("not a policy")
    assert main(["play", "notes.txt"]) == 2
    assert "notes.txt is not a checkpoint of torchrl-her" in capsys.readouterr().err
