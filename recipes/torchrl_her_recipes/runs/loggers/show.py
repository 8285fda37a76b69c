"""Passes pictures and videos to loggers, in the form that each logger takes."""

from __future__ import annotations

from functools import singledispatch
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageSequence
from tensorboard.compat.proto.summary_pb2 import Summary
from torchrl.record.loggers import CSVLogger, MLFlowLogger, TensorboardLogger, WandbLogger
from torchrl.record.loggers.common import Logger


@singledispatch
def show_file(logger: Logger, name: str, path: Path, step: int) -> None:
    """Passes a picture (``.png``) or a video (``.gif``) to a logger; does nothing if it takes no such files.

    A logger of your own gets videos through its method ``log_video``. To pass pictures to it, register a
    function for its class with ``@show_file.register``.

    Args:
        logger: logger that gets the file.
        name: name of the picture or video in the logger.
        path: path of the file.
        step: number of frames at which the file was made.
    """
    if path.suffix == ".gif":
        logger.log_video(name, read_film(path), step=step)


@show_file.register
def _(logger: CSVLogger, name: str, path: Path, step: int) -> None:
    """Does nothing: tables have no pictures."""


@show_file.register
def _(logger: TensorboardLogger, name: str, path: Path, step: int) -> None:
    with Image.open(path) as picture:
        width, height = picture.size
    image = Summary.Image(width=width, height=height, colorspace=3, encoded_image_string=path.read_bytes())
    logger.experiment.file_writer.add_summary(Summary(value=[Summary.Value(tag=name, image=image)]), step)


@show_file.register
def _(logger: WandbLogger, name: str, path: Path, step: int) -> None:
    import wandb  # noqa: PLC0415  (an extra)

    media = wandb.Video(str(path), format="gif") if path.suffix == ".gif" else wandb.Image(str(path))
    logger.log_metrics({name: media}, step=step)


@show_file.register
def _(logger: MLFlowLogger, _name: str, path: Path, _step: int) -> None:
    from mlflow import MlflowClient  # noqa: PLC0415  (an extra)

    client = MlflowClient(logger.log_dir)  # TorchRL stores the address of the service there
    client.log_artifact(logger.experiment.info.run_id, str(path), "pictures")


def read_film(path: Path) -> torch.Tensor:
    """Reads the frames of a GIF for TorchRL's loggers, [1, T, 3, H, W] of uint8."""
    with Image.open(path) as film:
        frames = [np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(film)]
    return torch.from_numpy(np.stack(frames)).permute(0, 3, 1, 2).unsqueeze(0)
