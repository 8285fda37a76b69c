"""The logger ``wandb``, and one of MLflow's, both without a network."""

from __future__ import annotations

import json
import os
import signal
import struct
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from torchrl.record.loggers import MLFlowLogger

from torchrl_her_recipes import LogTo, build, resume, run
from torchrl_her_recipes.runs.callbacks import RunView
from torchrl_her_recipes.runs.folder import RunFolder

from ....forks import fork
from ...small import small
from .test_log_to import SHORT, STEPS, DiesAt

ALONE = {"WANDB_MODE": "offline", "WANDB_ERROR_REPORTING": "false", "MLFLOW_DISABLE_TELEMETRY": "true"}


@pytest.fixture(autouse=True)
def wandb(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The package, alone; it takes a second to import."""
    package = pytest.importorskip("wandb", reason="needs the extra wandb")
    for name, value in ALONE.items():
        monkeypatch.setenv(name, value)
    monkeypatch.delenv("WANDB_PROJECT", raising=False)
    yield package
    package.teardown()  # its process


def _die(folder: Path) -> None:
    os.environ.update(ALONE)
    recipe = small(**SHORT, log="wandb")
    run(build(recipe), folder, callbacks=[DiesAt(3)], progress=False)


def wandb_records(folder: Path) -> list[Any]:
    """What wandb's files hold. They are logs of records, in blocks, as LevelDB has them."""
    from wandb.proto.wandb_internal_pb2 import Record  # noqa: PLC0415  (of a package that may be missing)

    records = []
    for path in sorted(folder.glob("wandb/*run-*/*.wandb")):
        data, place, parts = path.read_bytes(), 7, b""
        while place + 7 <= len(data):
            if (left := 32_768 - place % 32_768) < 7:
                place += left
                continue
            _, length, kind = struct.unpack("<IHB", data[place : place + 7])
            parts += data[place + 7 : place + 7 + length]
            place += 7 + length
            if kind in (1, 4):  # whole, or the last part
                record = Record()
                record.ParseFromString(parts)
                records.append(record)
                parts = b""
    return records


def wandb_history(folder: Path) -> dict[int, dict[str, Any]]:
    """The rows that wandb has, by step; a step that is there twice fails."""
    rows: dict[int, dict[str, Any]] = {}
    for record in wandb_records(folder):
        if record.WhichOneof("record_type") == "history":
            assert record.history.step.num not in rows
            rows[record.history.step.num] = {
                item.key or "/".join(item.nested_key): json.loads(item.value_json)
                for item in record.history.item
            }
    return rows


@pytest.mark.long
def test_after_a_kill_and_a_resumption_each_step_is_there_once(wandb: Any, tmp_path: Path) -> None:
    process = fork(_die, tmp_path)
    process.join(180)
    assert process.exitcode == -signal.SIGKILL
    wandb_id = (tmp_path / "wandb" / "run_id.txt").read_text()

    rows = resume(tmp_path, options={"keep_checkpoints": 1, "pictures": True}, progress=False).rows
    success = {step: row["success"] for step, row in zip(STEPS, rows, strict=True)}
    wandb.teardown()  # waits for its process, which writes the file

    history = wandb_history(tmp_path)
    assert {step: row["success/run_0"] for step, row in history.items()} == success
    assert {"curves/path", "policy/path", "virtual_goals/path"} <= set(history[STEPS[-1]])
    assert history[STEPS[-1]]["policy/_type"] == "video-file"
    assert "curves/path" not in history[STEPS[0]]
    (about,) = [own.run for own in wandb_records(tmp_path) if own.WhichOneof("record_type") == "run"]
    assert (about.run_id, about.project, about.display_name) == (wandb_id, "torchrl-her", tmp_path.name)
    config = {
        item.key: json.loads(item.value_json)
        for own in wandb_records(tmp_path)
        if own.WhichOneof("record_type") == "config"
        for item in own.config.update
    }
    assert config["learner.gamma"] == 0.98
    assert config["task.name"] == "hand_v0"


def test_mlflow_has_rows_options_and_pictures(tmp_path: Path) -> None:
    mlflow = pytest.importorskip("mlflow", reason="needs the extra test")
    recipe = small(epochs=2, log=[], pictures=True)
    address, artifacts = f"sqlite:///{tmp_path}/mlflow.db", (tmp_path / "artifacts").as_uri()
    logger = MLFlowLogger("throwing", address, artifact_location=artifacts)
    run(build(recipe), tmp_path / "run", callbacks=[LogTo(logger)], progress=False)
    mlflow.end_run()
    client = mlflow.MlflowClient(address)
    (own,) = client.search_runs([client.get_experiment_by_name("throwing").experiment_id])
    told = client.get_metric_history(own.info.run_id, "success/run_0")
    assert [metric.step for metric in told] == [480, 960]
    assert own.data.params["learner.gamma"] == "0.98"
    pictures = [file.path for file in client.list_artifacts(own.info.run_id, "pictures")]
    assert pictures == [f"pictures/{name}" for name in ("curves.png", "policy.gif", "virtual_goals.png")]


def view(folder: Path) -> RunView:
    home: Any = RunFolder(folder)
    return RunView(SimpleNamespace(), SimpleNamespace(), [], home)  # type: ignore[arg-type]


def test_a_run_that_the_service_knows_is_told_what_comes_behind(
    wandb: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from torchrl_her_recipes.runs.loggers import wandb_run  # noqa: PLC0415  (needs the extra)

    given: dict[str, Any] = {}

    def init(**options: Any) -> Any:
        given.update(options)
        return SimpleNamespace(offline=False, starting_step=961, dir=str(tmp_path), finish=lambda: None)

    monkeypatch.setattr(wandb, "init", init)
    _, known = wandb_run.open_wandb(view(tmp_path), 480)
    assert known == 960
    first = given["id"]
    wandb_run.open_wandb(view(tmp_path), 480)
    assert given["id"] == first
    assert given["resume"] == "allow"


def test_without_an_account_one_line_says_what_to_do(
    wandb: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def init(**_options: Any) -> None:
        raise wandb.errors.UsageError("No API key configured.")

    monkeypatch.setattr(wandb, "init", init)
    said = "^log=wandb cannot begin: ValueError: No API key configured. Without an account, set WANDB"
    with pytest.raises(ValueError, match=said):
        run(build(small(log="wandb")), tmp_path, progress=False)
