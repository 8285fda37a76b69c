"""Callbacks that pass a run's options, metrics and pictures to TorchRL's loggers."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import singledispatch
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image, ImageSequence
from tensorboard.compat.proto.summary_pb2 import Summary
from torchrl.record.loggers import CSVLogger, MLFlowLogger, TensorboardLogger, WandbLogger
from torchrl.record.loggers.common import Logger

from torchrl_her_recipes.config.loggers import LOGGERS
from torchrl_her_recipes.config.values import load_name
from torchrl_her_recipes.runs.callbacks import Callback, RunView

_OF_A_ROW = ("run", "seed")  # columns that identify a row and are not logged as metrics


class LogTo(Callback):
    """Callback that logs a run to one of TorchRL's loggers.

    It logs the options at the start, new rows of the table of metrics after each evaluation, and the pictures
    and the video at the end. The step is the number of frames. A metric's name contains the index of the run,
    as in ``success/run_0``. The caller closes the logger.

    When a run is resumed, all earlier rows are logged first, since the logger may be a new one.

    Args:
        logger: any TorchRL ``Logger``.

    Keyword Args:
        after: number of frames up to which rows are not logged, because the logger already has them.

    Example:
        >>> from tempfile import TemporaryDirectory
        >>> from torchrl.record.loggers import CSVLogger
        >>> from torchrl_her_recipes import LogTo, build, make_recipe, run
        >>> recipe = make_recipe(task="hand_v0", epochs=2, epoch_frames=320, num_envs=8, episodes=2)
        >>> with TemporaryDirectory() as folder:
        ...     result = run(build(recipe), callbacks=[LogTo(CSVLogger("mine", folder))], progress=False)
        ...     with open(f"{folder}/mine/scalars/updates/run_0.csv") as file:
        ...         file.read().split()
        ['320,0.0', '640,0.0']
    """

    def __init__(self, logger: Logger, *, after: int = 0) -> None:
        self.logger, self.after = logger, after
        self._told = after

    def on_start(self, run: RunView) -> None:
        """Logs the options, and all earlier rows of a resumed run."""
        self._told = self.after
        self.logger.log_hparams(flat(run.components.recipe.to_dict()))
        self._tell(run.rows)

    def on_epoch(self, run: RunView) -> None:
        """Logs the new rows."""
        self._tell(run.rows)

    def on_end(self, run: RunView) -> None:
        """Logs the run's pictures and its video."""
        if run.folder is not None:
            for path in (run.folder.curves, run.folder.goals, run.folder.video):
                if path.exists():
                    show_file(self.logger, path.stem, path, run.trainer.frames)
        self.logger.flush()

    def _tell(self, rows: Sequence[Mapping[str, float]]) -> None:
        for frames in sorted({int(row["frames"]) for row in rows if row["frames"] > self._told}):
            metrics = {
                f"{name}/run_{row['run']}": value
                for row in rows
                if row["frames"] == frames
                for name, value in row.items()
                if name not in _OF_A_ROW
            }
            self.logger.log_metrics(metrics, step=frames)
            self._told = frames
        self.logger.flush()  # a run resumed from the next checkpoint expects these rows in the logger


class LogByName(Callback):
    """Callback of ``log=NAME``: opens a logger in the run's folder, or continues an earlier one.

    The run closes the logger. A logger that fails does not end the run: it is opened again after the next
    epoch, and then receives the rows that it missed.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self._teller: LogTo | None = None

    def on_start(self, run: RunView) -> None:
        """Opens the logger."""
        self._kept = run.trainer.frames
        try:
            self._opened(run)
        except Exception as error:  # logging services raise errors of any type
            self.close()
            raise ValueError(f"log={self.name} cannot begin: {_reason(error)}") from error

    def on_epoch(self, run: RunView) -> None:
        """Logs the new rows."""
        if self._tried(lambda: self._opened(run).on_epoch(run), run):
            self._kept = run.trainer.frames

    def on_end(self, run: RunView) -> None:
        """Logs the pictures."""
        self._tried(lambda: self._opened(run).on_end(run), run)

    def close(self) -> None:
        """Closes the logger if it is open, also after an error."""
        teller, self._teller = self._teller, None
        if teller is not None:
            try:
                teller.logger.close()
            except Exception as error:
                warnings.warn(f"log={self.name} was not closed: {_reason(error)}", stacklevel=2)

    def _opened(self, run: RunView) -> LogTo:
        """Returns the logger; if it is not open, first opens it and logs earlier rows."""
        if self._teller is None:
            logger, known = load_name(LOGGERS[self.name].factory)(run, self._kept)
            self._teller = LogTo(logger, after=known)
            self._teller.on_start(run)
        return self._teller

    def _tried(self, call: Callable[[], None], run: RunView) -> bool:
        try:
            call()
        except Exception as error:  # a full disk, no network, ...: training must continue
            after = f"after {run.trainer.frames:,} frames"
            warnings.warn(f"log={self.name} fails {after}, the run continues: {_reason(error)}", stacklevel=2)
            self.close()
            return False
        return True


def _reason(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())


def flat(groups: Mapping[str, Mapping[str, Any]]) -> dict[str, bool | int | float | str]:
    """Flattens options to their long names; values that are neither numbers nor text become JSON.

    Example:
        >>> flat({"run": {"seed": 3, "log": ("wandb",)}, "task": {"name": "hand_v0", "options": None}})
        {'run.seed': 3, 'run.log': '["wandb"]', 'task.name': 'hand_v0', 'task.options': 'null'}
    """
    return {
        f"{group}.{name}": value if isinstance(value, bool | int | float | str) else json.dumps(value)
        for group, values in groups.items()
        for name, value in values.items()
    }


@singledispatch
def show_file(logger: Logger, name: str, path: Path, step: int) -> None:
    """Passes a picture (``.png``) or a video (``.gif``) to a logger.

    For classes of loggers that have no function below, videos are passed to ``log_video``, and pictures are
    not logged. To change this for your own class, register a function for it with ``@show_file.register``.

    Args:
        logger: logger that receives the file.
        name: name of the picture or video in the logger.
        path: path of the file.
        step: number of frames at which the file was made.
    """
    if path.suffix == ".gif":
        logger.log_video(name, read_film(path), step=step)


@show_file.register
def _(logger: CSVLogger, name: str, path: Path, step: int) -> None:
    """Does nothing: CSV files cannot hold pictures."""


@show_file.register
def _(logger: TensorboardLogger, name: str, path: Path, step: int) -> None:
    with Image.open(path) as picture:
        width, height = picture.size
    image = Summary.Image(width=width, height=height, colorspace=3, encoded_image_string=path.read_bytes())
    logger.experiment.file_writer.add_summary(Summary(value=[Summary.Value(tag=name, image=image)]), step)


@show_file.register
def _(logger: WandbLogger, name: str, path: Path, step: int) -> None:
    import wandb  # noqa: PLC0415  (imported here, since it is in an extra)

    media = wandb.Video(str(path), format="gif") if path.suffix == ".gif" else wandb.Image(str(path))
    logger.log_metrics({name: media}, step=step)


@show_file.register
def _(logger: MLFlowLogger, _name: str, path: Path, _step: int) -> None:
    from mlflow import MlflowClient  # noqa: PLC0415  (imported here, since it is in an extra)

    client = MlflowClient(logger.log_dir)  # TorchRL stores the address of the MLflow server in ``log_dir``
    client.log_artifact(logger.experiment.info.run_id, str(path), "pictures")


def read_film(path: Path) -> torch.Tensor:
    """Reads the frames of a GIF; returns [1, T, 3, H, W] of uint8, as TorchRL's loggers need them."""
    with Image.open(path) as film:
        frames = [np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(film)]
    return torch.from_numpy(np.stack(frames)).permute(0, 3, 1, 2).unsqueeze(0)
