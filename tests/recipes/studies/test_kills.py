"""A study that is killed, or has no room, at any moment ends bit for bit as one that was left alone."""

from __future__ import annotations

import random
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from filelock import FileLock

from torchrl_her import load_checkpoint
from torchrl_her_recipes.config.study import Study

from ...forks import server
from ..small import SMALL, assert_same_runs
from .killed_study import WHOM, Attempt

pytestmark = pytest.mark.skipif(
    sys.platform != "linux", reason="a fork server that shares torch is for Linux"
)
STUDY = Study(
    name="killed",
    recipe={**SMALL, "task": "hand_v1", "epoch_frames": 240, "warmup_frames": 160, "window": 10},
    vary={"algo": ["cher_ibs", "her", "filtered_her"]},
)
FILES = ("config.yaml", "goal_map.npz", "killed.png")


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, float]:
    """The folder of the study without a disturbance, and how long it took."""
    server()
    folder, began = tmp_path_factory.mktemp("alone") / "study", time.perf_counter()
    attempt = Attempt(STUDY, folder)
    assert attempt.wait(), attempt.result
    return folder, time.perf_counter() - began


def assert_same_studies(first: Path, second: Path) -> None:
    """Two folders of the study: all that was trained, and that nobody has left anything behind."""
    homes = sorted(path.parent.relative_to(first) for path in first.glob("*/*/config.yaml"))
    assert homes == sorted(path.parent.relative_to(second) for path in second.glob("*/*/config.yaml"))
    assert len(homes) == 3
    for home in homes:
        assert_same_runs(first / home, second / home)
    kept = [path.relative_to(first) for path in first.rglob("*") if path.name in FILES]
    assert len(kept) == 3 + 3 + 1
    for path in kept:
        assert (first / path).read_bytes() == (second / path).read_bytes(), path
    assert not list(second.rglob("*.part*"))
    for lock in second.rglob(".lock"):
        with FileLock(lock, timeout=0):
            pass


def kills(count: int, alone: tuple[Path, float], tmp_path: Path, draw: random.Random) -> Iterator[str]:
    """Kills somebody at random moments; the same study goes on until the next time, and comes to its end."""
    whole, seconds = alone
    study = 0
    while count:
        study += 1
        folder, attempts = tmp_path / str(study), []
        while count:
            whom = WHOM[count % len(WHOM)]
            attempts.append(Attempt(STUDY, folder))
            if not attempts[-1].kill(whom, after=draw.uniform(0.0, 0.9 * seconds), draw=draw):
                break
            count -= 1
            if whom == "worker" or draw.random() < 0.5:  # otherwise orphans meet their successors
                attempts[-1].wait()
            yield f"{whom} of study {study}, {count} to go"
        while not attempts[-1].wait():
            attempts.append(Attempt(STUDY, folder))
            assert len(attempts) < 100
        for attempt in attempts:
            attempt.wait()
        assert_same_studies(whole, folder)


@pytest.mark.long
@pytest.mark.parametrize("count", [3, pytest.param(50, marks=pytest.mark.full)])
def test_a_study_that_is_killed_at_any_moment_ends_bit_for_bit_as_one_that_was_not(
    count: int, alone: tuple[Path, float], tmp_path: Path
) -> None:
    assert len(list(kills(count, alone, tmp_path, random.Random(0)))) == count


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A small disk."""
    place = tmp_path / "disk"
    place.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=32m", "tmpfs", str(place)]
    try:
        subprocess.run(command, check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError) as error:
        pytest.skip(f"no disk can be mounted here: {error}")
    yield place
    subprocess.run(["umount", "--lazy", str(place)], check=True)


def fill(disk: Path) -> Path:
    """Takes up all the room that is left."""
    path = disk / "ballast"
    with suppress(OSError), open(path, "wb", buffering=0) as file:
        while file.write(bytes(4096)):
            pass
    with pytest.raises(OSError, match="No space left on device"):
        (disk / "more").write_bytes(bytes(4096))
    (disk / "more").unlink()
    return path


@pytest.mark.parametrize("count", [1, pytest.param(10, marks=pytest.mark.full)])
def test_a_study_whose_disk_is_full_goes_on_when_there_is_room(
    count: int, alone: tuple[Path, float], disk: Path
) -> None:
    whole, seconds = alone
    draw, said = random.Random(1), []
    for study in range(count):
        folder = disk / str(study)
        attempt = Attempt(STUDY, folder)
        time.sleep(draw.uniform(0.0, 0.9 * seconds))
        ballast = fill(disk)
        if not attempt.wait() and attempt.result is not None:
            said += attempt.result.failed.values()
        for path in folder.rglob("checkpoint.pt"):
            load_checkpoint(path)
        ballast.unlink()
        again = Attempt(STUDY, folder)
        assert again.wait(), again.result
        assert_same_studies(whole, folder)
        shutil.rmtree(folder)
    full = r".*(\[Errno 28\] No space left on device|OSError: cannot write \S+: no space left on device).*"
    assert [line for line in said if not re.fullmatch(full, line)] == []
