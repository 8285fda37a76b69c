"""A run that was stopped goes on from its checkpoint bit for bit as if it had not been."""

from __future__ import annotations

import os
import random
import signal
import sys
import time
from pathlib import Path
from shutil import copytree
from typing import Any
from unittest.mock import Mock

import pandas as pd
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from torchrl_her import load_checkpoint, save_checkpoint
from torchrl_her_recipes import Callback, Components, EarlyStopping, Recipe, RunView, build, cli, resume, run
from torchrl_her_recipes.runs import run as run_module
from torchrl_her_recipes.runs import state as run_state
from torchrl_her_recipes.runs.folder import RunFolder

from ...forks import server
from ..small import Refused, assert_same, assert_same_runs, small
from .killed import is_killed

KILLS = 20
# Everything there is to save: a curriculum whose stage changes on the way, q, priorities, held-back episodes.
ALL: dict[str, Any] = {
    "task": "hand_v1",
    "algo": "cher_ibs",
    "seed": 5,  # of which the first stage ends with the first epoch
    "epochs": 3,
    "episodes": 10,
    "window": 10,
    "success_threshold": 0.01,
    "guided_share": 0.5,
    "guided_decay": 0.5,
    "norm": "none",
    "normalize": False,
}


SHORT = small(algo="filtered_her", epochs=2)


@pytest.fixture(scope="module")
def ended(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run of two epochs."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    run(build(SHORT), folder, progress=False)
    return folder


@pytest.fixture(scope="module")
def _stopped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("stopped") / "run"
    run(build(SHORT), folder, callbacks=[Stop(1)], progress=False)
    return folder


@pytest.fixture
def stopped(_stopped: Path, tmp_path: Path) -> Path:
    """The folder of the same run, which was stopped after its first epoch, for one test."""
    return copytree(_stopped, tmp_path / "run")


class Stop(Callback):
    """Stops a run after some epochs."""

    def __init__(self, epochs: int) -> None:
        self.epochs = epochs

    def on_epoch(self, run: RunView) -> bool:
        return run.trainer.epochs == self.epochs


def press_ctrl_c(components: Components, batch: int) -> Components:
    """Components whose run is interrupted after a number of batches."""
    collect, count = components.collector.next, iter(range(10**6))

    def next_batch() -> Any:
        if next(count) == batch:
            os.kill(os.getpid(), signal.SIGINT)
        return collect()

    components.collector.next = next_batch  # type: ignore[method-assign]
    return components


def damage(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


# Killed


@pytest.mark.long
@pytest.mark.skipif(sys.platform != "linux", reason="a fork server that shares torch is for Linux")
@pytest.mark.parametrize("most", [2, pytest.param(KILLS, marks=pytest.mark.full)])
def test_a_run_that_is_killed_at_any_moment_ends_bit_for_bit_as_one_that_was_not(
    most: int, tmp_path: Path
) -> None:
    recipe, draw = small(**ALL, log="tensorboard"), random.Random(0)
    run(build(recipe), tmp_path / "whole", progress=False)
    server()
    began = time.perf_counter()
    assert not is_killed(recipe, tmp_path / "alone", after=300.0)
    seconds = time.perf_counter() - began
    assert_same_runs(tmp_path / "whole", tmp_path / "alone")
    assert pd.read_csv(tmp_path / "whole" / "metrics.csv")["stage"].nunique() == 2
    kills, folder = 0, tmp_path / "0"
    while kills < most:
        if is_killed(recipe, folder, after=draw.uniform(0.0, seconds)):
            kills += 1
        else:
            assert_same_runs(tmp_path / "whole", folder)
            folder = tmp_path / str(kills)
    assert not is_killed(recipe, folder, after=300.0)
    assert_same_runs(tmp_path / "whole", folder)
    assert not list(folder.glob("*.part.*"))
    events = EventAccumulator(str(folder / "tensorboard"))
    events.Reload()
    assert [event.step for event in events.Scalars("success/run_0")] == [480, 960, 1_440]


# Interrupted


@pytest.mark.parametrize(
    "options",
    [
        pytest.param(
            {"task": "robot_v2", "num_runs": 2, "algo": "filtered_her_ibs"},
            id="two runs",
            # The arm may hold the ball beyond the screen, which the grid over the screen says once.
            marks=pytest.mark.filterwarnings("ignore:goal .* lies outside"),
        ),
        pytest.param({**ALL, "normalize": True}, id="normalized in a curriculum"),
        pytest.param(
            {"task": "hand_v1", "num_runs": 2, "normalize": True, "priority_beta_end": 1.0}
            | {"goal_sources": {"future": 1, "actual": 2, "achieved": 2}}
            | {"symmetry": {"mirror": {0: 0.0}, "mirror_action": [0]}},
            id="normalized, with goals of other episodes and mirror images",
        ),
        pytest.param({"sampler": "uniform", "hard_update_interval": 7, "norm": "batch"}, id="hard updates"),
        pytest.param(
            {"learner": "redq", "critics": 3, "frames_per_update": 0.7, "epoch_frames": 240}
            | {"warmup_frames": 160, "hidden": 16, "num_runs": 2},
            id="several steps for each frame",
        ),
    ],
)
def test_ctrl_c_at_any_batch_changes_nothing(options: dict[str, Any], tmp_path: Path) -> None:
    recipe, draw = small(**{**options, "epochs": 3}), random.Random(1)
    run(build(recipe), tmp_path / "whole", progress=False)
    left = recipe.total_frames // (recipe.collection.num_envs * recipe.collection.steps_per_batch)
    batch = draw.randrange(left // 2)
    assert run(press_ctrl_c(build(recipe), batch), tmp_path / "part", progress=False).interrupted
    for _ in range(3):
        left -= batch + 1
        batch = draw.randrange(left // 2)
        components = press_ctrl_c(build(recipe), batch)
        assert resume(tmp_path / "part", components=components, progress=False).interrupted
    assert not resume(tmp_path / "part", progress=False).interrupted
    assert_same_runs(tmp_path / "whole", tmp_path / "part")


def test_ctrl_c_saves_what_there_is(tmp_path: Path) -> None:
    components = press_ctrl_c(build(small(epochs=3, pictures=True)), 14)  # in the middle of the third epoch
    result = run(components, tmp_path / "run", progress=False)
    assert result.interrupted
    assert [row["frames"] for row in result.rows] == [480, 960]
    saved = load_checkpoint(tmp_path / "run" / "checkpoint.pt")
    assert saved["trainer"]["frames"] == 15 * 80
    assert saved["trainer"]["measured"]["loss_value"].shape == (12, 1)
    assert (tmp_path / "run" / "curves.png").exists()


def test_a_second_ctrl_c_skips_the_pictures_and_loses_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    recipe = small(epochs=2, pictures=True)
    run(build(recipe), tmp_path / "whole", progress=False)
    with monkeypatch.context() as patch:
        patch.setattr(run_module, "film_policy", Mock(side_effect=KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            run(press_ctrl_c(build(recipe), 8), tmp_path / "part")
    assert "its pictures are drawn, unless Ctrl-C is pressed again" in capsys.readouterr().out
    assert not resume(tmp_path / "part", progress=False).interrupted
    assert_same_runs(tmp_path / "whole", tmp_path / "part")


def test_an_environment_that_cannot_be_saved_goes_on_with_new_episodes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_state, "_worlds", lambda _env, _processes: None)
    recipe = small(epochs=2)
    run(press_ctrl_c(build(recipe), 8), tmp_path / "run", progress=False)
    held = load_checkpoint(tmp_path / "run" / "checkpoint.pt")["buffer"]["writer"]["held"]
    components = build(recipe)
    result = resume(tmp_path / "run", components=components, progress=False)
    assert [row["frames"] for row in result.rows] == [480, 960]
    assert result.rows[-1]["rows_real"] + components.buffer.writer.held_back == 960
    assert held["collector"]["traj_ids"].max() < components.collector._carrier["collector", "traj_ids"].min()


# Between epochs


@pytest.mark.parametrize(
    "task", ["gym:torchrl_her_envs:torchrl_her/HandReach-v0", "tests.envs.common.own_point:Point"]
)
def test_environments_that_cannot_be_saved_go_on_bit_for_bit_between_epochs(
    task: str, tmp_path: Path
) -> None:
    frames = {"num_envs": 2, "epoch_frames": 160, "warmup_frames": 100}
    recipe = small(task=task, algo="filtered_her", num_runs=2, epochs=2, **frames)
    run(build(recipe), tmp_path / "whole", progress=False)
    early = EarlyStopping("epoch", at_least=1)
    assert run(build(recipe), tmp_path / "part", callbacks=[early], progress=False).stopped
    resume(tmp_path / "part", progress=False)
    assert_same_runs(tmp_path / "whole", tmp_path / "part")


def test_epochs_extend_a_finished_run_and_an_interrupted_one(
    ended: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recipe, whole = SHORT, tmp_path / "whole"
    run(build(recipe.replace(epochs=4)), whole, progress=False)
    copytree(ended, tmp_path / "ended")
    run(press_ctrl_c(build(recipe), 8), tmp_path / "stopped", progress=False)
    for name, folder in (("epochs", tmp_path / "ended"), ("run.epochs", tmp_path / "stopped")):
        assert cli.main(["train", "--resume", str(folder), f"{name}=4"]) == 0
        assert_same_runs(whole, folder)
        assert RunFolder(folder).recipe() == recipe.replace(epochs=4)  # as a later --resume takes it
    assert "success" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["seed=3"],
            "keep_buffer, pictures, log only; seed=3 would change its training so far: start a new run",
        ),
        (
            ["epochs=4", "learner.gamma=0.9"],
            "keep_checkpoints, keep_buffer, pictures, log only; learner.gamma=0.9 would change its training",
        ),
        (["preset=demo"], "keep_buffer, pictures, log only; preset=demo would change its training so far"),
        (["epoch=4"], "no option 'epoch'; did you mean epochs?"),
        (["epochs=4", "run.epochs=5"], "epochs=4 and run.epochs=5 set the same option"),
        (["epochs=4,5"], "epochs must be one value, got 4,5"),
        (["epochs=1"], "epochs must be at least 2, the number that the run in run has done, got 1"),
        (["--show"], "--resume cannot be given together with -m or --show"),
    ],
)
def test_what_cannot_extend_a_run_is_named_and_changes_nothing(
    arguments: list[str], message: str, ended: Path, monkeypatch: pytest.MonkeyPatch, refused: Refused
) -> None:
    monkeypatch.chdir(ended.parent)
    before = {path: path.stat().st_mtime_ns for path in ended.rglob("*")}
    assert message in refused("train", "--resume", "run", *arguments)
    assert {path: path.stat().st_mtime_ns for path in ended.rglob("*")} == before


def test_a_finished_run_has_no_buffer_and_cannot_have_more_epochs(tmp_path: Path, refused: Refused) -> None:
    recipe = small(epochs=2, keep_buffer=False)
    run(build(recipe), tmp_path, progress=False)
    assert [path.name for path in tmp_path.glob("checkpoint*")] == ["checkpoint.pt"]
    assert load_checkpoint(tmp_path / "checkpoint.pt")["buffer"] is None
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    said = (
        f"torchrl-her: the run in {tmp_path} cannot be extended beyond 2 epochs: its checkpoint has no "
        "replay buffer; only runs trained with keep_buffer=true keep it when they have finished\n"
    )
    for arguments in (["epochs=3"], ["epochs=3", "keep_buffer=true"], ["keep_buffer=true"]):
        assert refused("train", "--resume", str(tmp_path), *arguments) == said
    with pytest.raises(ValueError, match="cannot be extended beyond 2 epochs"):
        resume(tmp_path, components=build(recipe.replace(epochs=3)))
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_a_finished_run_draws_its_pictures_again_without_its_buffer(tmp_path: Path) -> None:
    recipe = small(epochs=2, keep_buffer=False, algo="filtered_her_ibs", pictures=True)
    run(build(recipe), tmp_path, progress=False)
    names = ("curves.png", "virtual_goals.png", "policy.gif", "policy.safetensors")
    same = (
        "curves.png",
        "virtual_goals.png",
        "policy.safetensors",
        "goal_map.npz",
        "best.safetensors",
    )  # the film shows others
    before = {name: (tmp_path / name).read_bytes() for name in same}
    for name in names:
        (tmp_path / name).unlink()
    assert len(resume(tmp_path, progress=False).rows) == 2
    assert {name: (tmp_path / name).read_bytes() for name in same} == before
    assert (tmp_path / "policy.gif").stat().st_size > 1_000
    assert load_checkpoint(tmp_path / "checkpoint.pt")["buffer"] is None


def test_a_buffer_that_was_kept_goes_when_it_is_not_wanted_any_more(ended: Path, tmp_path: Path) -> None:
    folder = copytree(ended, tmp_path / "run")
    assert load_checkpoint(folder / "checkpoint.pt")["buffer"] is not None
    resume(folder, options={"epochs": 3, "keep_buffer": False}, progress=False)
    assert load_checkpoint(folder / "checkpoint.pt")["buffer"] is None


def test_a_default_run_is_small_when_it_has_finished_and_ends_as_one_that_keeps_its_buffer(
    tmp_path: Path,
) -> None:
    options: dict[str, Any] = {"epochs": 2, "task": "hand_v1", "algo": "cher_ibs"}
    for name, keep in (("kept", True), ("small", False)):
        run(build(small(**options, keep_buffer=keep)), tmp_path / name, progress=False)
    kept, own = (load_checkpoint(tmp_path / name / "checkpoint.pt") for name in ("kept", "small"))
    apart = {"buffer", "demonstrations"}
    assert_same(
        *({name: value for name, value in state.items() if name not in apart} for state in (kept, own))
    )
    # The capacity of the buffer, not what is in it, is what a longer run fills.
    assert (tmp_path / "small" / "checkpoint.pt").stat().st_size < 2_000_000


def test_without_a_checkpoint_a_run_cannot_go_on(ended: Path, tmp_path: Path, refused: Refused) -> None:
    folder = copytree(ended, tmp_path / "run")
    (folder / "checkpoint.pt").unlink()
    said = f"torchrl-her: the run in {folder} cannot be resumed: checkpoint.pt is missing\n"
    assert refused("train", "--resume", str(folder), "epochs=3") == said


def test_options_and_components_are_not_given_together(ended: Path) -> None:
    with pytest.raises(
        ValueError, match="give resume.. either options or components that were made with them"
    ):
        resume(ended, components=build(small()), options={"epochs": 3})


def test_the_last_checkpoints_are_kept_until_the_run_has_finished(tmp_path: Path) -> None:
    recipe = small(epochs=5, epoch_frames=400, keep_checkpoints=3)
    run(build(recipe), tmp_path, callbacks=[Stop(4)], progress=False)
    epochs = {path.name: load_checkpoint(path)["trainer"]["epochs"] for path in tmp_path.glob("checkpoint*")}
    assert epochs == {"checkpoint.pt": 4, "checkpoint.1.pt": 3, "checkpoint.2.pt": 2}
    resume(tmp_path, progress=False)
    assert [path.name for path in tmp_path.glob("checkpoint*")] == ["checkpoint.pt"]
    assert load_checkpoint(tmp_path / "checkpoint.pt")["trainer"]["epochs"] == 5


def test_what_a_killed_run_left_half_written_is_removed(stopped: Path) -> None:
    killed, mine = stopped / "checkpoint.part.pt", stopped / "mine.part.pt"
    killed.write_bytes(b"half of it")
    mine.touch()
    resume(stopped, progress=False)
    assert mine.exists()
    assert not killed.exists()


@pytest.mark.filterwarnings("always")
def test_on_the_command_line_a_warning_is_one_line(stopped: Path, capsys: pytest.CaptureFixture[str]) -> None:
    damage(stopped / "checkpoint.pt")
    assert cli.main(["train", "--resume", str(stopped)]) == 0
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "damaged" in line]
    assert line.strip().startswith(f"torchrl-her: warning: {stopped / 'checkpoint.pt'} is damaged: ")


def test_the_one_before_a_damaged_checkpoint_is_used(ended: Path, stopped: Path) -> None:
    damage(stopped / "checkpoint.pt")
    said = r"checkpoint\.pt is damaged: its checksum does not match; checkpoint\.1\.pt, the one before, is"
    with pytest.warns(UserWarning, match=said):
        assert len(resume(stopped, progress=False).rows) == 2
    assert_same_runs(ended, stopped)


def test_a_run_before_its_first_epoch_can_be_resumed(ended: Path, tmp_path: Path) -> None:
    assert run(press_ctrl_c(build(SHORT), 0), tmp_path / "part", progress=False).interrupted
    (tmp_path / "part" / "checkpoint.1.pt").replace(tmp_path / "part" / "checkpoint.pt")
    resume(tmp_path / "part", progress=False)
    assert_same_runs(ended, tmp_path / "part")


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="there is no disk that is always full")
def test_a_full_disk_does_not_end_a_run(tmp_path: Path) -> None:
    (tmp_path / "checkpoint.part.pt").symlink_to("/dev/full")
    said = "no checkpoint after 0 frames, the run continues: .*No space left on device"
    with pytest.warns(UserWarning, match=said):
        run(build(small(epochs=2)), tmp_path, progress=False)
    assert load_checkpoint(tmp_path / "checkpoint.pt")["trainer"]["epochs"] == 2


def test_a_full_disk_does_not_end_the_run_when_its_table_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "metrics.part.csv").symlink_to("/dev/full")
    with pytest.warns(UserWarning, match=r"no table after 480 frames, the run continues: .*No space left"):
        result = run(build(small(epochs=2, log="tensorboard")), tmp_path, progress=False)
    assert len(result.rows) == len(RunFolder(tmp_path).rows()) == 2
    events = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    assert [event.step for event in events.Scalars("success/run_0")] == [480, 960]


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="there is no disk that is always full")
def test_a_full_disk_at_the_end_says_what_is_missing(tmp_path: Path) -> None:
    (tmp_path / "policy.part.safetensors").symlink_to("/dev/full")
    said = r"cannot write .*: no space left on device; policy\.safetensors will be written by: .* --resume"
    with pytest.raises(OSError, match=said):
        run(build(small(epochs=1)), tmp_path, progress=False)
    resume(tmp_path, progress=False)
    assert (tmp_path / "policy.safetensors").is_file()


def test_a_checkpoint_with_other_parts_is_refused_in_one_line(
    ended: Path, tmp_path: Path, refused: Refused
) -> None:
    copytree(ended, tmp_path / "run")
    path = tmp_path / "run" / "checkpoint.pt"
    state = load_checkpoint(path)
    del state["worlds"]
    save_checkpoint({**state, "recipe": {}}, path)
    assert refused("train", "--resume", str(tmp_path / "run"), "epochs=3") == (
        f"torchrl-her: {path} is not of this run: it has other parts (recipe, worlds): resume it with the "
        "version of torchrl-her and the components that it was written with\n"
    )


def test_parts_that_were_swapped_must_be_given_to_resume(tmp_path: Path) -> None:
    def swapped(recipe: Recipe) -> Components:
        components = build(recipe)
        components.optimizer = torch.optim.AdamW(components.loss.parameters(), lr=1e-3)
        components.critic = None
        return components

    recipe = small(epochs=2)
    run(swapped(recipe.replace(epochs=1)), tmp_path / "run", progress=False)
    with pytest.raises(ValueError, match="the run's critic was NoneType, not TensorDictModule"):
        resume(tmp_path / "run", progress=False)
    assert (tmp_path / "run" / "policy.safetensors").exists()
    assert resume(tmp_path / "run", components=swapped(recipe), progress=False).rows[-1]["epoch"] == 2


@pytest.mark.parametrize("text", ["epochs: [", "epochs: many", ""])
def test_a_spoilt_configuration_is_named(text: str, tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text(text)
    with pytest.raises(ValueError, match="config.yaml cannot be read"):
        resume(tmp_path)
