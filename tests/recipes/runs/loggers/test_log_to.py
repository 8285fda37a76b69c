"""Loggers: what they are told and shown, and that each step is there once after a kill and a resumption."""

from __future__ import annotations

import os
import runpy
import signal
import sys
from pathlib import Path
from typing import Any

import matplotlib
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torchrl.record.loggers import CSVLogger, TensorboardLogger

from torchrl_her_recipes import Callback, LogTo, RunView, build, resume, run
from torchrl_her_recipes.config import loggers as known
from torchrl_her_recipes.config.loggers import LoggerSpec, check_installed, register_logger
from torchrl_her_recipes.config.recipe import make_recipe
from torchrl_her_recipes.runs.loggers import log_to
from torchrl_her_recipes.runs.loggers.log_to import read_film

from ....forks import fork
from ...small import small

SHORT: dict[str, Any] = {"epochs": 5, "checkpoint_interval": 2}
STEPS = [480, 960, 1_440, 1_920, 2_400]


class DiesAt(Callback):
    """Ends the process, as ``kill -9`` does, at the first batch after so many epochs."""

    def __init__(self, epochs: int) -> None:
        self.epochs = epochs

    def on_batch(self, run: RunView) -> None:
        if run.trainer.epochs == self.epochs:
            os.kill(os.getpid(), signal.SIGKILL)


def _die(log: list[str], folder: Path, epochs: int) -> None:
    run(build(small(**SHORT, log=log)), folder, callbacks=[DiesAt(epochs)], progress=False)


def killed_run(folder: Path, log: list[str], *, after: int = 3) -> None:
    """Leaves a run behind that was killed after three epochs, one more than its last checkpoint has."""
    process = fork(_die, log, folder, after)
    process.join(120)
    assert process.exitcode == -signal.SIGKILL


def events(folder: Path) -> EventAccumulator:
    return EventAccumulator(str(folder)).Reload()


def csv_steps(path: Path) -> list[int]:
    return [int(line.split(",")[0]) for line in path.read_text().splitlines()]


@pytest.fixture(name="finished", scope="module")
def _finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with a logger of its recipe and two of the user's."""
    folder = tmp_path_factory.mktemp("finished")
    recipe = small(epochs=2, num_runs=2, log=["tensorboard"], pictures=True)
    given = CSVLogger("csv", str(folder)), TensorboardLogger("events", str(folder))
    run(build(recipe), folder, callbacks=[LogTo(own) for own in given], progress=False)
    assert given[1].is_alive  # it is the user's to close
    given[1].close()
    return folder


def test_each_logger_has_each_row(finished: Path) -> None:
    rows = (finished / "metrics.csv").read_text().splitlines()
    assert len(rows) == 5
    own, given = events(finished / "tensorboard"), events(finished / "events")
    for name in ("success/run_0", "success/run_1"):
        for logged in (own, given):
            assert [event.step for event in logged.Scalars(name)] == [480, 960]
        assert csv_steps(finished / "csv" / "scalars" / f"{name}.csv") == [480, 960]
    assert "seed/run_0" not in own.Tags()["scalars"]


def test_options_are_told(finished: Path) -> None:
    text = (finished / "csv" / "texts" / "hparams0.txt").read_text()
    assert "learner.gamma: 0.98" in text.splitlines()
    assert "task.options: null" in text.splitlines()
    metadata = events(finished / "tensorboard").SummaryMetadata("_hparams_/session_start_info")
    assert b"learner.gamma" in metadata.plugin_data.content


def test_pictures_and_the_film_are_shown_to_those_that_can(finished: Path) -> None:
    own = events(finished / "tensorboard")
    assert sorted(own.Tags()["images"]) == ["curves", "policy", "virtual_goals"]
    assert "policy" in events(finished / "events").Tags()["images"]
    (film,) = own.Images("policy")
    assert film.step == 960
    assert film.encoded_image_string == (finished / "policy.gif").read_bytes()
    assert not list((finished / "csv" / "videos").iterdir())
    assert read_film(finished / "policy.gif").shape[2] == 3


@pytest.mark.parametrize("after", [pytest.param(1, marks=pytest.mark.full), 3])
def test_after_a_kill_and_a_resumption_each_step_is_there_once(after: int, tmp_path: Path) -> None:
    killed_run(tmp_path, ["tensorboard"], after=after)
    before = [event.step for event in events(tmp_path / "tensorboard").Scalars("success/run_0")]
    assert before == STEPS[:after]  # behind the last checkpoint, too
    rows = resume(tmp_path, progress=False).rows
    own, success = events(tmp_path / "tensorboard"), [row["success"] for row in rows]
    assert [(event.step, event.value) for event in own.Scalars("success/run_0")] == [
        (step, pytest.approx(value)) for step, value in zip(STEPS, success, strict=True)
    ]


def test_a_logger_that_joins_later_is_told_the_whole_table(tmp_path: Path) -> None:
    run(build(small(epochs=2)), tmp_path, progress=False)
    assert not (tmp_path / "tensorboard").exists()
    resume(tmp_path, options={"epochs": 3, "log": ["tensorboard"]}, progress=False)
    steps = [event.step for event in events(tmp_path / "tensorboard").Scalars("epoch/run_0")]
    assert steps == [480, 960, 1_440]


def test_rows_that_a_logger_has_are_left_out(tmp_path: Path) -> None:
    logger = CSVLogger("mine", str(tmp_path))
    teller = LogTo(logger, after=480)
    run(build(small(epochs=2)), callbacks=[teller], progress=False)
    assert csv_steps(tmp_path / "mine" / "scalars" / "success" / "run_0.csv") == [960]


class Flaky(CSVLogger):
    """Fails in the middle of the second row."""

    fails = True

    def log_scalar(self, name: str, value: float, step: int | None = None) -> None:
        if Flaky.fails and step == 960 and name == "success/run_0":
            Flaky.fails = False
            raise OSError("no network")
        super().log_scalar(name, value, step)


def open_flaky(run: RunView, frames: int) -> tuple[CSVLogger, int]:
    if frames == 0 and not Flaky.fails:
        raise ConnectionError("nobody\nthere")
    return Flaky(f"from_{frames}", str(run.folder.path)), frames


@pytest.fixture(name="flaky")
def _flaky(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "flaky", sys.modules[__name__])
    monkeypatch.setattr(Flaky, "fails", True)
    monkeypatch.setitem(known.LOGGERS, "flaky", LoggerSpec(name="flaky", factory="flaky:open_flaky"))


@pytest.mark.usefixtures("flaky")
def test_a_logger_that_fails_is_opened_anew_and_told_what_it_missed(tmp_path: Path) -> None:
    recipe = small(epochs=3, log="flaky")
    said = "^log=flaky fails after 960 frames, the run continues: OSError: no network$"
    with pytest.warns(UserWarning, match=said):
        result = run(build(recipe), tmp_path, progress=False)
    assert len(result.rows) == 3
    assert csv_steps(tmp_path / "from_0" / "scalars" / "success" / "run_0.csv") == [480]
    assert csv_steps(tmp_path / "from_480" / "scalars" / "success" / "run_0.csv") == [960, 1_440]


@pytest.mark.usefixtures("flaky")
def test_a_logger_that_cannot_begin_ends_the_run_in_one_line(tmp_path: Path) -> None:
    Flaky.fails = False
    with pytest.raises(ValueError, match="^log=flaky cannot begin: ConnectionError: nobody there$"):
        run(build(small(log="flaky")), tmp_path, progress=False)


@pytest.mark.parametrize(
    ("log", "message"),
    [
        (
            ["tensorbord"],
            "log must be some of tensorboard, wandb.*, got 'tensorbord'; did you mean tensorboard?",
        ),
        (["wandb", "wandb"], "log names a logger twice: wandb, wandb"),
        (3, "log must be a list of tensorboard, wandb.*, got 3"),
        ([3], "log must be some of tensorboard, wandb.*, got 3"),
        ("csv", "got 'csv'; metrics.csv has the same numbers"),
        ("mlflow", r"got 'mlflow'; choose LogTo\(MLFlowLogger\(...\)\) in Python"),
    ],
)
def test_mistakes_in_log_are_named(log: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_recipe(log=log)


def test_a_logger_whose_package_is_missing_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    spec = LoggerSpec(name="other", factory="x:y", needs="not_there")
    monkeypatch.setitem(known.LOGGERS, "other", spec)
    with pytest.raises(ImportError, match=r"^log=other needs not_there: pip install '.\[not_there\]'$"):
        check_installed(("tensorboard", "other"))
    with pytest.raises(ValueError, match="there is a logger 'tensorboard' already"):
        register_logger(LoggerSpec(name="tensorboard", factory="x:y"))
    register_logger(spec)  # as a cell that runs again
    with pytest.raises(ValueError, match="there is a logger 'other' already"):
        register_logger(LoggerSpec(name="other", factory="z:y"))


@pytest.mark.parametrize("name", ["runs/plots.py", "reports/pictures.py"])
def test_importing_what_draws_leaves_matplotlib_s_backend_as_it_is(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(matplotlib, "use", None)
    before = matplotlib.rcParams["backend"]
    assert "Figure" in runpy.run_path(str(Path(log_to.__file__).parents[2] / name))
    assert matplotlib.rcParams["backend"] == before
