"""``log=csv``: TorchRL's ``CSVLogger``, a file for each metric."""

from __future__ import annotations

import shutil
from pathlib import Path

from torchrl.record.loggers import CSVLogger

from torchrl_her_recipes.runs.callbacks import RunView


def open_csv(run: RunView, _frames: int) -> tuple[CSVLogger, int]:
    """A logger into ``csv/`` of the run's folder, which is told the whole table anew."""
    assert run.folder is not None
    home = run.folder.path
    shutil.rmtree(Path(home / "csv" / "scalars"), ignore_errors=True)  # it can only append
    return CSVLogger("csv", str(home)), 0
