"""``log=wandb``: TorchRL's ``WandbLogger`` (extra ``wandb``), in a resumable run of Weights & Biases."""

from __future__ import annotations

import os
import shutil
import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import wandb
from torchrl.record.loggers import WandbLogger

from torchrl_her.files.writing import write_text
from torchrl_her_recipes.runs.callbacks import RunView

_PROJECT = "torchrl-her"


class WandbRun(WandbLogger):
    """Logger whose steps are frames; TorchRL's logger counts steps for each group of metrics."""

    def log_metrics(
        self, metrics: Mapping[str, Any], step: int | None = None, **_options: Any
    ) -> dict[str, Any]:
        """Logs numbers or pictures at a step, which is a number of frames."""
        return super().log_metrics(dict(metrics), step=step, override_global_step=True)


def open_wandb(run: RunView, _frames: int) -> tuple[WandbRun, int]:
    """Opens a logger for the project ``WANDB_PROJECT``, by default ``torchrl-her``.

    A resumed run keeps its id. If W&B is offline (``WANDB_MODE=offline``), the resumed run logs its whole
    table of metrics to new files, and earlier files are removed. If W&B is online, rows that were logged
    cannot be deleted, so only later rows are logged.

    Returns:
        The logger, and the number of frames up to which it already has rows.
    """
    assert run.folder is not None
    home = run.folder.path
    settings = wandb.Settings(console="off", silent=True)  # keeps wandb from printing to the terminal
    own_id = remembered(home / "wandb" / "run_id.txt")
    project = os.environ.get("WANDB_PROJECT", _PROJECT)
    try:
        logger = WandbRun(
            exp_name=home.name,
            save_dir=str(home),
            id=own_id,
            project=project,
            log_env_packages=False,  # not needed: run.json has the versions of packages
            settings=settings,
            reinit="create_new",  # other runs may be open in this process
        )
    except wandb.errors.UsageError as error:
        raise ValueError(f"{error} Without an account, set WANDB_MODE=offline.") from error
    experiment = logger.experiment
    if experiment.offline:
        _remove_others(home / "wandb", Path(experiment.dir).parent)
        return logger, 0
    return logger, max(experiment.starting_step - 1, 0)


def _remove_others(home: Path, current: Path) -> None:
    """Removes earlier offline logs of the run, whose contents the current log repeats."""
    for folder in home.glob("offline-run-*"):
        if folder.resolve() != current.resolve():
            shutil.rmtree(folder, ignore_errors=True)


def remembered(path: Path) -> str:
    """Reads the id of a run from a file; if the file has none, makes a new id and writes it."""
    if path.is_file() and (run_id := path.read_text().strip()):
        return run_id
    run_id = uuid.uuid4().hex[:12]
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, run_id)
    return run_id
