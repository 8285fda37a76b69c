"""``log=wandb``: TorchRL's ``WandbLogger`` (extra ``wandb``), in a run of Weights & Biases that can go on."""

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
    """Counts frames as the steps of the whole run; TorchRL's own has a counter for each group of metrics."""

    def log_metrics(
        self, metrics: Mapping[str, Any], step: int | None = None, **_options: Any
    ) -> dict[str, Any]:
        """Logs numbers, or pictures, of one step."""
        return super().log_metrics(dict(metrics), step=step, override_global_step=True)


def open_wandb(run: RunView, _frames: int) -> tuple[WandbRun, int]:
    """A logger into the project ``WANDB_PROJECT`` or ``torchrl-her``; a run that goes on has the same id.

    A run that is offline (``WANDB_MODE=offline``) is told the whole table anew, and replaces what was there.
    The service takes nothing back: it keeps what it knows, and is told what comes behind.
    """
    assert run.folder is not None
    home = run.folder.path
    settings = wandb.Settings(console="off", silent=True)  # the output is ours
    own_id = remembered(home / "wandb" / "run_id.txt")
    project = os.environ.get("WANDB_PROJECT", _PROJECT)
    try:
        logger = WandbRun(
            exp_name=home.name,
            save_dir=str(home),
            id=own_id,
            project=project,
            log_env_packages=False,  # run.json has them
            settings=settings,
            reinit="create_new",  # beside others in this process
        )
    except wandb.errors.UsageError as error:
        raise ValueError(f"{error} Without an account, set WANDB_MODE=offline.") from error
    own = logger.experiment
    if own.offline:
        _remove_others(home / "wandb", Path(own.dir).parent)
        return logger, 0
    return logger, max(own.starting_step - 1, 0)


def _remove_others(home: Path, current: Path) -> None:
    """Removes what was logged offline before: the one that has begun says all of it again."""
    for folder in home.glob("offline-run-*"):
        if folder.resolve() != current.resolve():
            shutil.rmtree(folder, ignore_errors=True)


def remembered(path: Path) -> str:
    """The id of a run that a file holds; a new one, which is written there, if there is none."""
    if path.is_file() and (own := path.read_text().strip()):
        return own
    own = uuid.uuid4().hex[:12]
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, own)
    return own
