"""``log=mlflow``: TorchRL's ``MLFlowLogger`` (extra ``mlflow``), in a run of MLflow that can go on."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mlflow import MlflowClient
from mlflow.entities import Metric, Param, Run, RunTag
from mlflow.exceptions import MlflowException
from torchrl.record.loggers import MLFlowLogger
from torchrl.record.loggers.common import Logger

from torchrl_her.files.writing import write_text
from torchrl_her_recipes.runs.callbacks import RunView

_EXPERIMENT = "torchrl-her"
_LAST = "epoch/run_0"  # is logged behind the other numbers of a row: where it is, the row is
_METRICS, _PARAMS, _LETTERS = 1_000, 100, 6_000  # what the service takes at once


class MLflowRun(MLFlowLogger):
    """Logs into a given run of MLflow; TorchRL's own begins a new one, the one that is active in its process.

    Args:
        client: of the service.
        run: of it.
    """

    def __init__(self, client: MlflowClient, run: Run) -> None:
        self.client, self._run = client, run
        Logger.__init__(self, run.info.run_name, client.tracking_uri)

    def _create_experiment(self) -> Run:
        self.id = self._run.info.experiment_id
        return self._run

    @property
    def _run_id(self) -> str:
        return self._run.info.run_id

    def log_scalar(self, name: str, value: float, step: int | None = None) -> None:
        """Logs a number."""
        self.log_metrics({name: value}, step)

    def log_metrics(
        self, metrics: Mapping[str, Any], step: int | None = None, **_options: Any
    ) -> dict[str, Any]:
        """Logs the numbers of one step, as few requests as can be."""
        now = int(time.time() * 1000)
        names = sorted(metrics, key=lambda name: name == _LAST)
        own = [Metric(name, float(metrics[name]), now, step or 0) for name in names]
        for first in range(0, len(own), _METRICS):
            self.client.log_batch(self._run_id, metrics=own[first : first + _METRICS])
        return dict(metrics)

    def log_hparams(self, cfg: Mapping[str, Any]) -> None:
        """Logs options. None can be changed there: another value that a run goes on with becomes a tag."""
        known = self.client.get_run(self._run_id).data.params
        values = {name: str(value)[:_LETTERS] for name, value in cfg.items()}
        new = [Param(name, value) for name, value in values.items() if name not in known]
        for first in range(0, len(new), _PARAMS):
            self.client.log_batch(self._run_id, params=new[first : first + _PARAMS])
        changed = {name: value for name, value in values.items() if known.get(name, value) != value}
        self.client.log_batch(self._run_id, tags=[RunTag(name, value) for name, value in changed.items()])

    def steps(self) -> list[int]:
        """The steps whose rows are there."""
        return sorted({own.step for own in self.client.get_metric_history(self._run_id, _LAST)})

    def shutdown(self, timeout: float | None = None) -> None:
        """Says that the run has ended."""
        if self.is_alive:
            self.client.set_terminated(self._run_id)
        super().shutdown(timeout)


def open_mlflow(run: RunView, _frames: int) -> tuple[MLflowRun, int]:
    """A logger into the service of ``MLFLOW_TRACKING_URI``, or a database in the run's folder.

    It takes nothing back: it keeps what it knows, and is told what comes behind.
    """
    assert run.folder is not None
    home = run.folder.path / "mlflow"
    home.mkdir(exist_ok=True)
    address = os.environ.get("MLFLOW_TRACKING_URI", "")
    logging.getLogger("mlflow.store.db").setLevel(logging.WARNING)  # it speaks of the tables that it makes
    client = MlflowClient(address or f"sqlite:///{home.resolve() / 'mlflow.db'}")
    own = _own_run(client, address, run.folder.path.name, home)
    client.update_run(own.info.run_id, status="RUNNING")
    logger = MLflowRun(client, own)
    return logger, max(logger.steps(), default=0)


def _own_run(client: MlflowClient, address: str, name: str, home: Path) -> Run:
    """The run that the folder's was told to before at this address, or a new one."""
    note = home / "run_id.txt"
    if note.is_file():
        own_id, _, where = note.read_text().partition(" ")
        if where == address:
            return client.get_run(own_id)
    artifacts = None if address else (home / "artifacts").resolve().as_uri()
    own = client.create_run(_experiment(client, artifacts), run_name=name)
    write_text(note, f"{own.info.run_id} {address}")
    return own


def _experiment(client: MlflowClient, artifacts: str | None) -> str:
    name = os.environ.get("MLFLOW_EXPERIMENT_NAME", _EXPERIMENT)
    found = client.get_experiment_by_name(name)
    if found is None:
        try:
            return client.create_experiment(name, artifact_location=artifacts)
        except MlflowException:
            found = client.get_experiment_by_name(name)  # another run has just made it
            if found is None:
                raise
    return found.experiment_id
