"""What finished runs do not need any more: that it is found and removed, and nothing else."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from torchrl_her import load_checkpoint
from torchrl_her_recipes import build, find_waste, resume, run
from torchrl_her_recipes.cli import main
from torchrl_her_recipes.runs.folder import RunFolder
from torchrl_her_recipes.runs.state import without_buffer

from ..small import assert_same, small, stop_after


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    """A folder with a run that still has its buffer, one that is to keep it, and an unfinished one."""
    folder = tmp_path / "runs"
    recipe = small(epoch_frames=480)
    run(build(recipe), folder / "study" / "kept", progress=False)
    run(build(recipe), folder / "old", progress=False)
    config = folder / "old" / "config.yaml"
    config.write_text(config.read_text().replace("keep_buffer: true", "keep_buffer: false"))
    (folder / "old" / "checkpoint.1.pt").write_bytes(bytes(1_000))
    stopped = build(recipe)
    stop_after(stopped, 8)
    assert run(stopped, folder / "unfinished", progress=False).interrupted
    return folder


def age(path: Path) -> None:
    """As if it had been written an hour ago."""
    before = time.time() - 3_600
    os.utime(path, (before, before))


def test_what_is_found_is_what_the_list_says_and_is_removed(
    runs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    killed, busy = runs / "unfinished" / "checkpoint.part.pt", runs / "unfinished" / "metrics.part.csv"
    killed.write_bytes(bytes(2_500))
    age(killed)
    busy.touch()
    stranger = runs / "unfinished" / "film.part.mp4"
    stranger.touch()
    age(stranger)
    before = {path: path.read_bytes() for path in runs.rglob("*") if path.is_file()}
    checkpoint = runs / "old" / "checkpoint.pt"
    state = load_checkpoint(checkpoint)

    found = {(waste.path, waste.kind) for waste in find_waste(runs)}
    assert found == {
        (runs / "old" / "checkpoint.1.pt", "older checkpoint"),
        (checkpoint, "replay buffer"),
        (killed, "unfinished file"),
    }
    assert main(["clean", str(runs)]) == 0
    *lines, total = capsys.readouterr().out.splitlines()
    assert f"  1.0 kB  {runs / 'old' / 'checkpoint.1.pt'} (older checkpoint)" in lines
    assert f"  2.5 kB  {killed} (unfinished file)" in lines
    assert len(lines) == 3
    assert total.endswith(f"in all; `torchrl-her clean {runs} --yes` removes it")
    assert {path: path.read_bytes() for path in runs.rglob("*") if path.is_file()} == before

    assert main(["clean", str(runs), "--yes"]) == 0
    assert capsys.readouterr().out.splitlines()[-1].endswith("  removed")
    gone = {runs / "old" / "checkpoint.1.pt", killed}
    after = {path: path.read_bytes() for path in runs.rglob("*") if path.is_file()}
    assert set(after) == set(before) - gone
    assert {path for path in after if after[path] != before[path]} == {checkpoint}
    assert_same(load_checkpoint(checkpoint), without_buffer(state))
    assert main(["clean", str(runs), "--yes"]) == 0
    assert capsys.readouterr().out == "there is nothing to remove\n"


def test_the_size_of_a_buffer_is_what_its_file_shrinks_by(runs: Path) -> None:
    (waste,) = [own for own in find_waste(runs / "old") if own.kind == "replay buffer"]
    before = waste.path.stat().st_size
    waste.remove()
    assert before - waste.path.stat().st_size == pytest.approx(waste.size, rel=0.05)


def test_a_cleaned_run_is_done_and_an_unfinished_one_goes_on(runs: Path) -> None:
    assert main(["clean", str(runs), "--yes"]) == 0
    assert RunFolder(runs / "old").is_done
    assert len(resume(runs / "old", progress=False).rows) == 2
    with pytest.raises(ValueError, match="keep_buffer=true"):
        resume(runs / "old", options={"epochs": 3}, progress=False)
    assert not resume(runs / "unfinished", progress=False).interrupted
    assert len(resume(runs / "study" / "kept", options={"epochs": 3}, progress=False).rows) == 3


def test_a_damaged_run_is_left_alone(runs: Path) -> None:
    (runs / "old" / "config.yaml").write_text("run: [")
    assert list(find_waste(runs / "old")) == []


def test_a_folder_that_is_not_there_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["clean", str(tmp_path / "nowhere")]) == 2
    assert capsys.readouterr().err == f"torchrl-her: {tmp_path / 'nowhere'} is no folder\n"
