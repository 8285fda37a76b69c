"""The command itself, with worker processes, killed at random moments."""

from __future__ import annotations

import csv
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from filelock import FileLock

from .searches import RECIPE

pytest.importorskip("optuna", reason="needs the extra tune")

TRIALS = 8


@pytest.mark.full
@pytest.mark.parametrize("kill", ["parent", "workers", "both", "Ctrl-C"])
def test_no_trial_is_lost_and_no_process_left_whoever_is_killed(tmp_path: Path, kill: str) -> None:
    draw = random.Random(kill)
    options = [f"{name}={value}" for name, value in RECIPE.items() if name not in ("task.options", "hidden")]
    size = ["task.options.bits=3", "hidden=16", f"folder={tmp_path / 'search'}"]
    command = [sys.executable, "-P", "-m", "torchrl_her_recipes", "tune", *options, *size]
    command += ["--trials", str(TRIALS), "--jobs", "2", "--pruner", "halving"]
    known: set[int] = set()
    for _ in range(2):
        with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.DEVNULL) as process:
            children = _wait_for_children(process)
            known |= children
            time.sleep(draw.uniform(0.0, 15.0))
            _kill(process, children, kill)
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    with open(tmp_path / "search" / "trials.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == TRIALS
    assert {row["state"] for row in rows} <= {"complete", "pruned"}
    deadline = time.monotonic() + 60
    while left := {pid for pid in known if _is_alive(pid)}:
        assert time.monotonic() < deadline, left
        time.sleep(0.1)
    locks = list(tmp_path.rglob(".lock"))
    assert tmp_path / "search" / ".lock" in locks
    for lock in locks:  # nobody holds one
        with FileLock(lock, timeout=0):
            pass


def _wait_for_children(process: subprocess.Popen[bytes]) -> set[int]:
    while process.poll() is None:
        listed = subprocess.run(
            ["pgrep", "-P", str(process.pid)], capture_output=True, text=True, check=False
        )
        if listed.stdout:
            return {int(line) for line in listed.stdout.split()}
        time.sleep(0.1)
    return set()  # it has come to its end already


def _kill(process: subprocess.Popen[bytes], children: set[int], what: str) -> None:
    if process.poll() is not None:
        return
    if what == "Ctrl-C":
        process.send_signal(signal.SIGINT)
    if what in ("parent", "both"):
        process.kill()
    if what in ("workers", "both"):
        for pid in filter(_is_alive, children):
            os.kill(pid, signal.SIGKILL)


def _is_alive(pid: int) -> bool:
    """Whether a worker is at work; nobody may have waited for one that has ended."""
    status = Path(f"/proc/{pid}/status")
    try:
        text = status.read_text()
    except OSError:
        return False
    return "worker_main" in Path(f"/proc/{pid}/cmdline").read_text() and "State:\tZ" not in text
