"""Sweeps: they skip what is done, go on with what is not, and leave no process behind."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from filelock import FileLock

from torchrl_her_recipes import cli, run_sweep, unfinished_sweep
from torchrl_her_recipes.config.recipe import Recipe
from torchrl_her_recipes.runs.folder import RunFolder
from torchrl_her_recipes.studies.jobs import Job, Outcome
from torchrl_her_recipes.studies.sweep import plan_sweep

from ..small import overrides, small
from .test_schedule import Actors


class Writers(Actors):
    """Play workers that leave finished runs behind, of a success that is their seed divided by ten."""

    def __init__(self, *broken: str) -> None:
        super().__init__()
        self.broken, self.did = broken, []  # type: tuple[str, ...], list[str]

    def run(self, job: Job) -> Outcome:
        self.did.append(job.label)
        if job.label in self.broken:
            return Outcome(error="why")
        home = RunFolder(job.folder)
        home.create()
        home.describe(job.recipe)
        seed, epoch = job.recipe.run.seed, job.recipe.run.epochs
        counters = {"run": 0, "seed": seed, "epoch": epoch, "frames": 9, "seconds": 1.0}
        home.write_table([{**counters, "success": seed / 10}])
        home.policy.touch()
        return Outcome()


def runs(*seeds: int) -> dict[str, Recipe]:
    return {f"seed_{seed}": small(seed=seed) for seed in seeds}


def test_what_is_done_is_skipped_and_what_failed_is_tried_again(tmp_path: Path) -> None:
    folder = tmp_path / "sweep"
    first, second = Writers("seed_2"), Writers()
    result = run_sweep(runs(1, 2, 3), folder, workers=first, progress=False)
    assert result.successes == {"seed_1": [0.1], "seed_3": [0.3]}
    assert result.failed == {"seed_2": "why"}
    assert sorted(first.did) == ["seed_1", "seed_2", "seed_3"]
    assert unfinished_sweep(runs(1, 2, 3), tmp_path) == folder
    assert unfinished_sweep(runs(1, 2), tmp_path) is None  # that is another sweep
    result = run_sweep(runs(1, 2, 3), folder, workers=second, progress=False)
    assert result.successes == {"seed_1": [0.1], "seed_2": [0.2], "seed_3": [0.3]}
    assert second.did == ["seed_2"]
    assert unfinished_sweep(runs(1, 2, 3), tmp_path) is None  # all is done


def test_a_folder_with_other_runs_or_in_use_is_refused(tmp_path: Path) -> None:
    run_sweep(runs(1), tmp_path, workers=Writers(), progress=False)
    with pytest.raises(ValueError, match="seed_1 holds a run with other options; choose another folder"):
        plan_sweep({"seed_1": small(seed=1, epochs=3)}, tmp_path)
    (tmp_path / "seed_1" / "config.yaml").write_text("epochs: [")  # the power failed
    (tmp_path / "seed_1" / "metrics.csv").unlink()
    plan_sweep(runs(1), tmp_path)
    with (
        FileLock(tmp_path / ".lock"),
        pytest.raises(ValueError, match="another process is running a sweep in"),
    ):
        run_sweep(runs(1), tmp_path, workers=Writers(), progress=False)


def test_the_same_command_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    command = ["train", "-m", "task=hand_v0", "algo=her", "seed=1,2", *overrides()]
    made = [Writers("hand_v0_her_s2_1"), Writers(), Writers()]
    workers = iter(made)
    monkeypatch.setattr("torchrl_her_recipes.make_workers", lambda jobs: next(workers), raising=False)
    assert cli.main(command) == 1
    said, errors = capsys.readouterr()
    (folder,) = Path("runs").iterdir()
    assert said.splitlines()[0] == f"sweep: 2 of 2 runs to go: {folder}"
    assert f"torchrl-her: {folder}/hand_v0_her_s2_1 failed: why" in errors.splitlines()
    assert said.splitlines()[-1] == "the whole sweep: success 10%; 1 of 2 did not end"
    assert cli.main(command) == 0
    said = capsys.readouterr().out
    assert said.splitlines()[0] == f"sweep: 1 of 2 runs to go: {folder}"
    assert "  hand_v0_her_s1_0  done" in said.splitlines()
    assert "hand_v0_her_s1_0: success 10%" in said.splitlines()
    assert made[1].did == ["hand_v0_her_s2_1"]
    time.sleep(1.0)  # folders are named by the second
    assert cli.main(command) == 0  # a new one: the other is done
    assert made[2].did == ["hand_v0_her_s1_0", "hand_v0_her_s2_1"]
    assert len(list(Path("runs").iterdir())) == 2


def test_jobs_needs_a_sweep(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["train", "--jobs", "2"]) == 2
    assert capsys.readouterr().err == "torchrl-her: --jobs is for a sweep: give -m as well\n"


@pytest.mark.full
def test_ctrl_c_saves_all_runs_and_ends_all_processes(tmp_path: Path) -> None:
    options = overrides(epochs=100_000, folder="sweep", compile="never")
    program = [sys.executable, "-m", "torchrl_her_recipes"]
    command = [*program, "train", "-m", "--jobs", "2", "seed=1,2", *options]
    before = 0
    for _ in range(2):
        with open(tmp_path / "said", "w") as said:
            process = subprocess.Popen(command, cwd=tmp_path, stdout=said, stderr=said)
            deadline = time.monotonic() + 200
            while epochs(tmp_path) <= before:
                assert process.poll() is None
                assert time.monotonic() < deadline
                time.sleep(0.1)
            workers = children(process.pid)
            process.send_signal(signal.SIGINT)
            assert process.wait(100) == 130
        assert len(workers) == 2
        assert not [pid for pid in workers if Path(f"/proc/{pid}").exists()]
        lines = (tmp_path / "said").read_text().splitlines()
        assert lines[-1] == "interrupted: the same command resumes it"
        assert "hand_v0_filtered_her_s1_0: interrupted" in lines
        assert bool(before) == any(f"at epoch {before} of 100000" in line for line in lines)
        before = epochs(tmp_path)


def epochs(folder: Path) -> int:
    """How many epochs the slower run has done."""
    tables = [RunFolder(path).rows() for path in (folder / "sweep").glob("hand*")]
    return min((len(rows) for rows in tables), default=0) if len(tables) == 2 else 0


def children(pid: int) -> list[int]:
    """Its worker processes."""
    listed = subprocess.run(
        ["pgrep", "-P", str(pid), "-f", "worker_main"], capture_output=True, text=True, check=False
    )
    return [int(line) for line in listed.stdout.split()]
