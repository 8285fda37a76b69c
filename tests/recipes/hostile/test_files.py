"""Files of strangers, damaged in every way: nothing of them runs, and what is wrong is one line."""

from __future__ import annotations

import random
import resource
import shutil
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from filelock import FileLock

from torchrl_her import load_checkpoint, save_checkpoint
from torchrl_her.demonstrations import Demonstrations
from torchrl_her_envs import make_controller, make_env
from torchrl_her_recipes import build, load_policy
from torchrl_her_recipes.cli.train_options import requests
from torchrl_her_recipes.config.shipped import CONF
from torchrl_her_recipes.config.study import load_study
from torchrl_her_recipes.runs.folder import RunFolder
from torchrl_her_recipes.runs.goal_map import GoalMap
from torchrl_her_recipes.runs.run import resume, run

from ..policies.tiny import tiny_policy
from ..small import Refused, small
from . import damage
from .damage import Damage

_ROOM = 2 << 30  # bytes beside those that the tests have already
TEXT = (damage.bits, damage.cut, damage.exchange, damage.lines, damage.bomb, damage.tags)
BYTES = (damage.bits, damage.cut, damage.exchange)
TENSORS = (
    *BYTES,
    *map(damage.in_the_body, BYTES),
    damage.records,
    damage.records,
    damage.description,
    damage.description,
    damage.harmful,
    damage.saved_entries,
    damage.saved_entries,
)
POLICY = (*BYTES, damage.header_size, damage.header_text, *[damage.header_entries] * 4, damage.weights)


@dataclass(frozen=True)
class Kind:
    """A kind of file.

    Attributes:
        name: of the file among those that are damaged.
        read: what a user does with it.
        ways: to damage it.
        command: that reads it, for a file that is refused.
    """

    name: str
    read: Callable[[Path], Any]
    ways: tuple[Damage, ...]
    command: tuple[str, ...]


def _use_run(path: Path) -> Any:
    home = RunFolder(path.parent)
    return home.recipe(), home.rows()


KINDS = {
    "checkpoint": Kind("run/checkpoint.pt", load_checkpoint, TENSORS, ("train", "--resume", "DIR")),
    "policy": Kind("policy.safetensors", load_policy, POLICY, ("play", "FILE", "--out", "NEW")),
    "best policy": Kind(
        "run/best.safetensors", load_policy, POLICY, ("play", "DIR", "--best", "--out", "NEW")
    ),
    "demonstrations": Kind(
        "demos.pt",
        Demonstrations.load,
        TENSORS,
        ("train", "task=hand_v0", "demonstrations.file=FILE", "demonstrations.episodes=1", "folder=NEW"),
    ),
    "configuration": Kind("run/config.yaml", _use_run, TEXT, ("train", "--resume", "DIR")),
    "table": Kind("run/metrics.csv", _use_run, (*BYTES, damage.lines), ("play", "DIR", "--out", "NEW")),
    "goals": Kind("run/goal_map.npz", GoalMap.load, BYTES, ("plot", "DIR", "--out", "NEW")),
    "preset": Kind(
        "mine.yaml",
        lambda path: requests((f"preset={path}",), multirun=False),
        TEXT,
        ("train", "preset=FILE", "--show"),
    ),
    "study": Kind(
        "study.yaml",
        lambda path: list(load_study(str(path)).cells()),
        TEXT,
        ("study", "FILE", "--plan", "--folder", "NEW"),
    ),
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a file of each kind."""
    folder = tmp_path_factory.mktemp("whole")
    recipe = small(task="hand_v0", algo="her_ibs", epochs=1, hidden=8, keep_buffer=False)
    run(build(recipe), folder / "run", progress=False)
    tiny_policy().save(folder / "policy.safetensors", card=False)
    env = make_env("hand_v0", num_envs=2, seed=0)
    played = env.rollout(20, make_controller(env), break_when_any_done=False)
    Demonstrations.from_rollout(played, task="hand_v0", first=True).save(folder / "demos.pt")
    shutil.copy(CONF / "preset" / "demo.yaml", folder / "mine.yaml")
    shutil.copy(CONF / "study" / "curriculum.yaml", folder / "study.yaml")
    return folder


@pytest.fixture(autouse=True)
def _little_room() -> Iterator[None]:
    """A file that asks for much memory does not get it."""
    if sys.platform != "linux":
        yield
        return
    before = resource.getrlimit(resource.RLIMIT_AS)
    taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (taken + _ROOM, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)


def there_is(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*")}


def try_files(kind: Kind, whole: Path, tmp_path: Path, cases: range) -> tuple[int, list[tuple[int, str]]]:
    """Damages a file in some ways; returns how often it was still of use, and what was said otherwise."""
    place, refused, fine = tmp_path / "place", [], 0
    home = (whole / kind.name).parent
    for case in cases:
        _damaged(kind, whole, place, case, tmp_path / "trap")
        before, path = there_is(tmp_path), place / Path(kind.name).name
        try:
            kind.read(path)
            fine += 1
        except (ValueError, OSError) as error:
            said = str(error)
            assert path.name in said, (case, said)
            assert len(said.splitlines()) == 1, (case, said)
            assert len(said) < 1_000, (case, said)
            refused.append((case, said))
        except BaseException as error:
            raise AssertionError(f"case {case} of {kind.name}: {type(error).__name__}: {error}") from error
        assert not (tmp_path / "trap").exists(), case
        assert there_is(tmp_path) == before, case
    assert home.is_dir()
    return fine, refused


def _damaged(kind: Kind, whole: Path, place: Path, case: int, trap: Path) -> None:
    """The files of a folder, one of them damaged."""
    draw = random.Random(case)
    source = whole / kind.name
    if source.parent != whole and not place.exists():
        shutil.copytree(source.parent, place)
    place.mkdir(exist_ok=True)
    shutil.copy(source, place / source.name)
    kind.ways[case % len(kind.ways)](place / source.name, draw, trap)


def check_commands(kind: Kind, whole: Path, tmp_path: Path, cases: list[int], refused: Refused) -> None:
    """On the command line a file that is refused is one line and exit code 2."""
    place = tmp_path / "place"
    path = place / Path(kind.name).name
    command = " ".join(kind.command).replace("FILE", str(path)).replace("DIR", str(place))
    command = command.replace("NEW", str(tmp_path / "new.gif"))
    for case in cases:
        _damaged(kind, whole, place, case, tmp_path / "trap")
        said = refused(*command.split())
        assert path.name in said, (case, said)
        assert len(said.splitlines()) == 1, (case, said)
        assert said.rstrip("\n").isprintable(), (case, said)
        assert not (tmp_path / "trap").exists()
        assert not (tmp_path / "new.gif").exists()


QUICK, COMMANDS, ALL = 40, 3, 10_000


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize(
    "count", [QUICK, pytest.param(-(-ALL // len(KINDS)), marks=pytest.mark.full)], ids=["few", "many"]
)
def test_a_damaged_file_is_of_use_or_refused_in_one_line(
    count: int, name: str, whole: Path, tmp_path: Path, refused: Refused
) -> None:
    kind = KINDS[name]
    kind.read(whole / kind.name)
    fine, useless = try_files(kind, whole, tmp_path, range(count))
    assert fine + len(useless) == count
    assert len(useless) > count / 4
    chosen = random.Random(0).sample([case for case, _ in useless], COMMANDS)
    check_commands(kind, whole, tmp_path, chosen, refused)


def test_a_checkpoint_of_another_make_is_not_gone_on_from(whole: Path, tmp_path: Path) -> None:
    shutil.copytree(whole / "run", tmp_path / "run")
    path = tmp_path / "run" / "checkpoint.pt"
    state, said = load_checkpoint(path), []
    for case in range(10):
        save_checkpoint(damage.entries(state, random.Random(case), tmp_path / "trap"), path)
        try:
            resume(tmp_path / "run", progress=False)
        except ValueError as error:
            said.append(str(error))
    assert len(said) > 1
    assert all("checkpoint" in line and len(line.splitlines()) == 1 for line in said)


def test_arrays_that_unpack_to_gigabytes_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "goal_map.npz"
    np.savez_compressed(path, counts=np.zeros((1, 12_000, 12_000), np.uint8))
    assert path.stat().st_size < 1 << 20
    with pytest.raises(
        ValueError, match=r"goal_map\.npz is damaged: its arrays take 144,000,\d+ bytes, more"
    ):
        GoalMap.load(path)


@pytest.mark.parametrize("value", ["..", ".", "a/../../b", "a\0b"])
def test_a_study_has_no_folder_outside_its_own(value: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump({"vary": {"algo": ["her"]}, "cases": {value: {"k": 2}}}))
    with pytest.raises(ValueError, match=r"cases of mine must hold options by name"):
        list(load_study(str(path)).cells())


@pytest.mark.parametrize("name", ["policy.gif", "checkpoint.part.pt", "tensorboard", "wandb"])
@pytest.mark.parametrize("command", [("train", "--resume"), ("play",), ("export",)], ids=" ".join)
def test_nothing_is_written_through_a_link_out_of_a_run_s_folder(
    command: tuple[str, ...], name: str, whole: Path, tmp_path: Path, refused: Refused
) -> None:
    shutil.copytree(whole / "run", tmp_path / "run")
    (tmp_path / "mine").mkdir()
    (tmp_path / "run" / name).unlink(missing_ok=True)
    (tmp_path / "run" / name).symlink_to(tmp_path / "mine")
    said = f"{name} is a link that leads out of the run's folder"
    assert said in refused(*command, str(tmp_path / "run"))
    assert not list((tmp_path / "mine").iterdir())


@pytest.mark.skipif(sys.platform != "linux", reason="locks of processes that were killed are for Linux")
def test_one_process_at_a_time_trains_into_a_folder(whole: Path, tmp_path: Path) -> None:
    shutil.copytree(whole / "run", tmp_path / "run")
    with (
        FileLock(tmp_path / "run" / ".lock"),
        pytest.raises(ValueError, match=f"another process is training in {tmp_path}/run"),
    ):
        resume(tmp_path / "run", progress=False)
