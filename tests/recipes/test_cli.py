"""The command line: what it prints, what it leaves behind, and how it fails."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from torchrl_her_recipes import cli
from torchrl_her_recipes.versions import check_versions

from .small import overrides

PRESETS = sorted((Path(cli.__file__).parent / "conf" / "preset").glob("*.yaml"))


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_train_play_and_resume(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["train", "task=hand_v0", "algo=her", "seed=4", *overrides(folder="out")]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("run: ")
    assert lines[0].endswith("out")
    assert lines[-1].startswith(lines[0])
    assert yaml.safe_load(Path("out/config.yaml").read_text())["algo"] == "her"

    assert cli.main(["play", "out", "--goals", "2", "--size", "64"]) == 0
    assert "of 2 goals achieved: out/play.gif" in capsys.readouterr().out
    assert Path("out/play.gif").stat().st_size > 0

    assert cli.main(["train", "--resume", "out"]) == 0


def test_the_default_folder_names_task_algorithm_and_seed() -> None:
    assert cli.main(["train", "task=robot_v0", "seed=2", *overrides(epochs=1)]) == 0
    (folder,) = Path("runs").iterdir()
    assert folder.name.endswith("robot_v0_filtered_her_s2")


def test_sweeps(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["train", "-m", "algo=her,no_hindsight", *overrides(epochs=1)]) == 0
    (sweep,) = Path("runs").iterdir()
    assert sorted(path.name for path in sweep.iterdir() if path.is_dir()) == [
        "hand_v0_her_s0_0",
        "hand_v0_no_hindsight_s0_1",
    ]


def test_list(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["list"]) == 0
    out = capsys.readouterr().out
    for name in ("hand_wall_v1", "robot_reach", "filtered_her", "demo"):
        assert name in out
    assert max(len(line) for line in out.splitlines()) < 110


@pytest.mark.parametrize("preset", PRESETS, ids=lambda path: path.stem)
def test_every_preset_runs(preset: Path) -> None:
    shrunk = [
        option
        for option in overrides(folder="out", epochs=1, epoch_frames=800)
        if not option.startswith("num_runs")
    ]
    assert cli.main(["train", f"preset={preset.stem}", *shrunk, "num_runs=1"]) == 0
    config = yaml.safe_load(Path("out/config.yaml").read_text())
    for name, value in yaml.safe_load(preset.read_text()).items():
        if f"{name}=" not in " ".join([*shrunk, "num_runs="]):
            assert config[name] == value


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["train", "task=hand_v9"], "unknown task 'hand_v9'; the tasks are hand_reach"),
        (["train", "algo=sarsa"], "unknown algorithm 'sarsa'; the algorithms are no_hindsight, her, filt"),
        (["train", "speed=3"], "Could not override 'speed'"),
        (["train", "epochs=many"], "Value 'many' of type 'str' could not be converted to Integer"),
        (["train", "preset=no"], "Could not find 'preset/no'"),
        (["train", "buffer_size=10"], "must fit buffer_size=10"),
        (["train", "threshold=-1"], "threshold must be above 0, got -1.0"),
        (["train", "folder=/proc/nothing/here"], "cannot use /proc/nothing"),
        (["train", "folder="], "folder must name a folder, got nothing"),
        (["train", "-m", "seed=0,1", "folder=out"], "a sweep's folder is hydra.sweep.dir=DIR"),
        (["train", "buffer_size=99999999999999"], "there is not enough memory: buffer_size"),
        (["train", "--resume", "nowhere"], "nowhere is no folder of a run"),
        (["train", "--resume=nowhere"], "nowhere is no folder of a run"),
        (["play", "nowhere"], "nowhere is neither the folder of a run nor one of the trained"),
        (["fly"], "unknown command 'fly'; the commands are train, play, export, plot, study, report, list"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith("torchrl-her: ")
    assert message in captured.err
    assert captured.err.count("\n") == 1
    assert "Traceback" not in captured.err
    assert not Path("nowhere").exists()
    assert not Path("runs").exists()


def test_no_command_shows_how_to_use_it(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([]) == 2
    assert cli.main(["--help"]) == 0
    assert "train [NAME=VALUE ...]" in capsys.readouterr().out


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_that_may_not_be_written(capsys: pytest.CaptureFixture[str]) -> None:
    Path("locked").mkdir(mode=0o500)
    assert cli.main(["train", "folder=locked/run"]) == 2
    assert "cannot use locked/run: permission denied" in capsys.readouterr().err


def test_versions_that_do_not_fit_are_named_with_the_remedy() -> None:
    installed = {"torch": "2.13.0+cpu", "tensordict": "0.14.3", "torchrl": "0.14.1"}
    with pytest.raises(ImportError, match=r"^torch 2.13.0 does not fit .* install .*torch==2.14.1"):
        check_versions(installed.__getitem__)
    check_versions({**installed, "torch": "2.14.1+cu130"}.__getitem__)


def test_versions_are_checked_before_anything_is_imported(tmp_path: Path) -> None:
    """A torchrl that cannot even be imported beside this torch is still named in one line."""
    for name, version in (("torch", "2.13.0"), ("tensordict", "0.14.3"), ("torchrl", "0.14.1")):
        (tmp_path / f"{name}.py").write_text("raise RuntimeError('not to be imported')")
        about = tmp_path / f"{name}-{version}.dist-info"
        about.mkdir()
        (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    command = [sys.executable, "-m", "torchrl_her_recipes", "list"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith(
        "torchrl-her: torch 2.13.0 does not fit this version of torchrl-her; install "
    )
    assert done.stderr.count("\n") == 1
