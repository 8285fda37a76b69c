"""Jobs: what a worker does with a run's folder, and how one travels."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from torchrl_her_recipes import Callback, EarlyStopping, make_recipe
from torchrl_her_recipes.runs.folder import RunFolder
from torchrl_her_recipes.studies import jobs
from torchrl_her_recipes.studies.jobs import (
    Job,
    Outcome,
    can_resume,
    kept_progress,
    pack,
    read_progress,
    run_job,
    unpack,
)

from ..small import small

RECIPE = small(task="hand_v0", algo="her", epoch_frames=160)


@pytest.fixture
def job(tmp_path: Path) -> Job:
    return Job(label="her", recipe=RECIPE, folder=tmp_path / "her")


def test_a_job_without_a_checkpoint_begins_again(job: Job) -> None:
    job.folder.mkdir()
    (job.folder / "config.yaml").write_text("what was written when the power failed")
    (job.folder / "metrics.csv").write_text("run,epoch,seconds\n0,7,1.5\n")
    (job.folder / "error.txt").touch()
    assert read_progress(job.folder).epochs == 7
    assert run_job(job) == Outcome()
    assert read_progress(job.folder).epochs == 2
    assert can_resume(job.folder)
    assert not (job.folder / "error.txt").exists()


@pytest.mark.parametrize(
    "left", ["", "run,epoch,seconds\n", "run,epoch,seconds\n0,7", "run,epoch,seconds\n0,7,1.5,\0"]
)
def test_a_table_that_lost_its_end_holds_up_nobody(left: str, job: Job) -> None:
    job.folder.mkdir()
    (job.folder / "metrics.csv").write_text(left)
    assert read_progress(job.folder).epochs == 0
    if "7" in left:
        with pytest.raises(ValueError, match=r"metrics\.csv is damaged: a line is not a row of the table"):
            RunFolder(job.folder).rows()


def test_a_job_that_was_killed_before_its_configuration_was_written_begins_again(job: Job) -> None:
    job.folder.mkdir()
    (job.folder / "checkpoint.pt").write_text("the first one")
    assert not can_resume(job.folder)
    assert run_job(job) == Outcome()
    assert kept_progress(job).epochs == 2


def test_a_job_that_was_killed_while_it_drew_its_pictures_draws_them(job: Job) -> None:
    job = replace(job, recipe=RECIPE.replace(pictures=True))
    assert run_job(job) == Outcome()
    assert kept_progress(job).epochs == 2
    (job.folder / "policy.safetensors").unlink()
    (job.folder / "curves.png").unlink()
    rows = (job.folder / "metrics.csv").read_text()
    assert kept_progress(job).epochs == 1
    assert run_job(job) == Outcome()
    assert kept_progress(job).epochs == 2
    assert (job.folder / "curves.png").exists()
    assert (job.folder / "metrics.csv").read_text() == rows


def test_what_goes_wrong_is_an_outcome_and_its_story_is_kept(
    job: Job, monkeypatch: pytest.MonkeyPatch
) -> None:
    job.folder.mkdir()

    def fail(recipe: object) -> None:
        raise MemoryError("no room\nfor this")

    monkeypatch.setattr(jobs, "build", fail)
    assert run_job(job) == Outcome(error="MemoryError: no room for this")
    story = (job.folder / "error.txt").read_text()
    assert story.startswith("Traceback")
    assert "no room" in story


def test_ctrl_c_before_it_has_begun_is_no_failure(job: Job, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(job: Job) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(jobs, "_train", interrupt)
    assert run_job(job) == Outcome(interrupted=True)


def test_a_folder_arrives_as_it_was_sent_in_place_of_what_was_there(tmp_path: Path) -> None:
    sent, there = tmp_path / "sent", tmp_path / "there"
    (sent / "tensorboard").mkdir(parents=True)
    for name in (
        "config.yaml",
        "checkpoint.pt",
        "checkpoint.1.pt",
        "policy.safetensors",
        "tensorboard/events",
    ):
        (sent / name).write_bytes(name.encode())
    there.mkdir()
    (there / "old").touch()
    unpack(pack(sent, checkpoints=False), there)
    assert sorted(path.name for path in there.rglob("*") if path.is_file()) == [
        "config.yaml",
        "events",
        "policy.safetensors",
    ]
    assert (there / "tensorboard" / "events").read_bytes() == b"tensorboard/events"
    unpack(pack(sent, checkpoints=True), there)
    assert can_resume(there)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["sent", "there"]  # nothing half done is left


def test_a_job_goes_on_in_a_folder_that_has_travelled(job: Job, tmp_path: Path) -> None:
    assert run_job(replace(job, recipe=RECIPE.replace(epochs=1))) == Outcome()
    config = job.folder / "config.yaml"
    config.write_text(config.read_text().replace("epochs: 1", "epochs: 2"))
    there = replace(job, folder=tmp_path / "elsewhere")
    unpack(pack(job.folder, checkpoints=True), there.folder)
    assert run_job(there) == Outcome()
    assert read_progress(there.folder).epochs == 2


@contextmanager
def _stop_after(*, frames: int, told: str) -> Iterator[list[Callback]]:
    """What surrounds the run of the test below."""
    yield [EarlyStopping("frames", at_least=frames)]
    Path(told).touch()


def test_what_surrounds_a_run_travels_with_its_job_and_gives_it_callbacks(job: Job) -> None:
    told = job.folder.with_name("told")
    own = replace(job, around=f"{__name__}:_stop_after", options={"frames": 160, "told": str(told)})
    assert Job.from_plain(own.to_plain()) == own
    assert run_job(own) == Outcome()
    assert read_progress(job.folder).epochs == 1  # of two
    assert told.exists()


def test_a_task_of_the_program_itself_is_named(job: Job) -> None:
    own = replace(job, recipe=make_recipe(task="__main__:Point"))
    with pytest.raises(ValueError, match="task=__main__:Point is made in the script or notebook"):
        Job.from_plain(own.to_plain())
