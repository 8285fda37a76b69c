"""``log=tensorboard``: TorchRL's ``TensorboardLogger``, extended so that killed runs can be resumed."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from torch.utils.tensorboard import SummaryWriter
from torch.utils.tensorboard.summary import hparams
from torchrl.record.loggers import TensorboardLogger

from torchrl_her_recipes.runs.callbacks import RunView

_NAME = "tensorboard"
_PATIENCE = 3  # longest wait in seconds, in case the clock was set back


class TensorboardEvents(TensorboardLogger):
    """Logger that writes events of TensorBoard, and can drop earlier events from a given step on.

    Args:
        exp_name: name of the folder.
        log_dir: path of its parent folder.

    Keyword Args:
        purge_step: step from which events of earlier files are dropped; None keeps all events.
    """

    def __init__(self, exp_name: str, log_dir: str, *, purge_step: int | None = None) -> None:
        self._purge_step = purge_step
        super().__init__(exp_name, log_dir)

    def _create_experiment(self) -> SummaryWriter:
        return SummaryWriter(f"{self.log_dir}/{self.exp_name}", purge_step=self._purge_step)

    def log_hparams(self, cfg: dict[str, Any]) -> None:
        """Logs options to the same file; TorchRL's method would make another folder at each start."""
        for summary in hparams(cfg, {}):
            self.experiment.file_writer.add_summary(summary)


def open_tensorboard(run: RunView, frames: int) -> tuple[TensorboardEvents, int]:
    """Opens a logger in ``tensorboard/`` of the run's folder; drops events after ``frames`` frames."""
    assert run.folder is not None
    home = run.folder.path
    before = list((home / _NAME).glob("events.*"))
    if before:
        _wait_for_the_next_second(before)
    return TensorboardEvents(_NAME, str(home), purge_step=frames + 1), frames if before else 0


def _wait_for_the_next_second(files: list[Path]) -> None:
    """Waits until a new file's name, which has the time in seconds, sorts after the names of ``files``."""
    newest = max(int(path.name.split(".")[3]) for path in files)
    while newest >= int(time.time()) > newest - _PATIENCE:
        time.sleep(0.05)
