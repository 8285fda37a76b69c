"""The command line: what it prints, what it leaves behind, and how it fails."""

from __future__ import annotations

import os
import re
import shlex
from pathlib import Path

import pytest
import yaml

import torchrl_her_recipes
from torchrl_her_recipes import ALGORITHMS, cli
from torchrl_her_recipes.config.plain_files import read_yaml
from torchrl_her_recipes.config.presets import load_preset
from torchrl_her_recipes.config.shipped import CONF, find_file

from .small import Refused, overrides
from .studies.forked_worker import fork_workers

PRESETS = sorted((CONF / "preset").glob("*.yaml"))


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_train_play_and_resume(capsys: pytest.CaptureFixture[str]) -> None:
    own = overrides(task="hand_v0", algo="her", seed=4, folder="out", pictures=True)
    assert cli.main(["train", *own]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("run: ")
    assert lines[0].endswith("out")
    assert lines[-1] == f"{lines[0]} (curves.png, policy.gif, metrics.csv, checkpoint.pt)"
    assert yaml.safe_load(Path("out/config.yaml").read_text())["hindsight"]["algo"] == "her"

    assert cli.main(["play", "out", "--goals", "2", "--size", "64"]) == 0
    assert "of 2 goals achieved: out/play.gif" in capsys.readouterr().out
    assert Path("out/play.gif").stat().st_size > 0

    assert cli.main(["train", "--resume", "out"]) == 0


def test_the_default_folder_names_task_and_seed() -> None:
    assert cli.main(["train", "task=robot_v0", "seed=2", *overrides(epochs=1)]) == 0
    (folder,) = Path("runs").iterdir()
    assert folder.name.endswith("robot_v0_s2")


def test_sweeps(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    fork_workers(monkeypatch)
    assert cli.main(["train", "-m", "algo=her,no_hindsight", *overrides(epochs=1)]) == 0
    (sweep,) = Path("runs").iterdir()
    assert sorted(path.name for path in sweep.iterdir() if path.is_dir()) == [
        "hand_v0_her_s0_0",
        "hand_v0_no_hindsight_s0_1",
    ]
    *_, last = capsys.readouterr().out.splitlines()
    assert re.fullmatch(r"the whole sweep: median success \d+%, worst \d+%(; \d of 2 runs below 10%)?", last)


def test_the_end_of_several_runs_hides_none_that_failed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = [{"run": run, "epoch": 1, "success": success} for run, success in enumerate((0.9, 0.02, 0.95))]
    result = torchrl_her_recipes.RunResult(rows=rows, folder=Path("out"))
    monkeypatch.setattr(torchrl_her_recipes, "run", lambda components, folder: result)
    assert cli.main(["train", "num_runs=3", *overrides(folder="out")]) == 0
    said = "median success 90%, worst 2%; 1 of 3 runs below 10%"
    assert f"{said} in the last evaluation" in capsys.readouterr().out


def test_list(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["list"]) == 0
    out = capsys.readouterr().out
    for name in ("hand_wall_v1", "robot_reach", "demo", *ALGORITHMS):
        assert f"  {name} " in out
    assert max(len(line) for line in out.splitlines()) < 110


@pytest.mark.parametrize("preset", PRESETS, ids=lambda path: path.stem)
def test_every_preset_runs(preset: Path) -> None:
    shrunk = [
        option
        for option in overrides(folder="out", epochs=1, episodes=2)
        if not option.startswith("num_runs")
    ]
    if preset.stem == "panda_stack":
        pytest.importorskip("panda_gym")
    assert cli.main(["train", f"preset={preset.stem}", *shrunk, "num_runs=1"]) == 0
    config = yaml.safe_load(Path("out/config.yaml").read_text())
    for group, own in load_preset(preset.stem).items():
        for name, value in own.items():
            dropped = name == "floor_is_relative"  # for goals that have no such weights
            if not dropped and f"{name}=" not in " ".join([*shrunk, "num_runs="]):
                stored = read_yaml(find_file(name, value)) if name == "symmetry" else value
                assert config[group][name] == stored


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("train task=hand_v9", "unknown task 'hand_v9'; did you mean hand_v0? The tasks are hand_reach"),
        ("train speed=3", "no option 'speed'"),
        ("train task=bit_flip task.options.X=3", "bit_flip takes no option 'X'; its options are bits"),
        ("train task=bit_flip 'task.options={1: 2}'", "a mapping of options by name, got {1: 2}"),
        ("train task.options.threshold=1 threshold=2", "are the same option: give one of them"),
        ("train algo=cher stages=3", "list of stages, each with its options by name, got 3"),
        ("train -m seed=0,0", "the sweep has the same run twice: seed=0; give each value once"),
        ("train -m seed=1,2,01 k=2,3", "same run twice: seed=1 k=2; give each value once"),
        ("train -m algo=her,", "algo needs a value, got 'algo=her,'"),
        ("train task=[hand_v0", "[hand_v0 cannot be read as a value of YAML"),
        (
            "train task_options.continuing_task=false",
            "written task.options.NAME=VALUE: task.options.continuing_task, not task_options.continuing_task",
        ),
        (
            "train task=bit_flip action_penalty=0",
            "action_penalty=0 has no effect with learner=dqn: leave it out",
        ),
        ("--import no_such_module list", "there is no module 'no_such_module', neither in this folder"),
        ("--import own.py list", "named as in an import statement, without .py; got 'own.py'"),
        ("trian", "unknown command 'trian'; did you mean train? The commands are check, train, record, play"),
        ("train hand_v0", "got 'hand_v0'; did you mean task=hand_v0?"),
        ("train seed=1,2", "several are a sweep: torchrl-her train -m"),
        ("train -x", "No such option '-x'"),
        ("train --dry", "No such option '--dry'\n"),
        ("train --folde x", "No such option '--folde'. Did you mean '--folder'?"),
        ("train frames=1000 epochs=3", "epochs=3 and frames=1000 say the same: give one of them"),
        ("train strategy=mine", "to use your own, import the module that registers it: torchrl-her --import"),
        ("train --resume", "Option '--resume' requires an argument"),
        ("play hand_v0 --goals 0", "0 is not in the range x>=1"),
        ("play hand_v0 --out x.png", "its suffix must be one of .gif, .mp4"),
        ("study biass", "there is no study 'biass'; did you mean bias?"),
        ("train epochs=many", "epochs must be a whole number, got 'many'"),
        ("train folder=/proc/nothing/here", "cannot use /proc/nothing"),
        ("train folder=", "folder needs a value, got 'folder='"),
        ("train buffer_size=99999999999999", "buffer_size=99999999999999 needs 11000000 GB"),
        ("train hidden=10000000", "there is not enough memory: can't allocate memory: you tried to"),
        ("train --resume nowhere", "nowhere is no folder of a run"),
        ("train --resume=nowhere", "nowhere is no folder of a run"),
        (
            "play nowhere",
            "nowhere is neither the folder of a run, nor the file of an exported policy, nor one",
        ),
        (
            "fly",
            "unknown command 'fly'; the commands are check, train, record, play, export, plot, study, report",
        ),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(command: str, message: str, refused: Refused) -> None:
    assert message in refused(*shlex.split(command))
    assert not Path("nowhere").exists()
    assert not Path("runs").exists()


def test_no_command_shows_how_to_use_it(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([]) == 2
    assert cli.main(["--help"]) == 0
    assert "Train, compare and show policies" in capsys.readouterr().out


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_that_may_not_be_written(refused: Refused) -> None:
    Path("locked").mkdir(mode=0o500)
    assert "cannot use locked/run: permission denied" in refused("train", "folder=locked/run")
