"""What runs leave on the disk that nobody needs any more."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from torchrl_her.trainers.checkpoint import CheckpointError, load_checkpoint, save_checkpoint
from torchrl_her_recipes.runs.folder import RunFolder
from torchrl_her_recipes.runs.state import without_buffer

_AT_REST = 600.0  # seconds: a file that was written to since then may belong to a run under way


@dataclass(frozen=True)
class Waste:
    """Something that can be removed.

    Attributes:
        path: of the file.
        kind: ``"replay buffer"``, ``"older checkpoint"`` or ``"unfinished file"``.
        size: bytes that it takes up.
    """

    path: Path
    kind: str
    size: int

    def remove(self) -> None:
        """Removes it: the file, or the replay buffer in it.

        Raises:
            OSError: it cannot be removed.
            ValueError: it is a checkpoint that was damaged meanwhile.
        """
        if self.kind == "replay buffer":
            save_checkpoint(without_buffer(load_checkpoint(self.path)), self.path)
        else:
            self.path.unlink(missing_ok=True)


def find_waste(folder: str | Path) -> Iterator[Waste]:
    """What can be removed of the runs in a folder, without losing anything but more epochs of finished runs.

    These are the replay buffers and older checkpoints of finished runs, and files that were being written
    when a run was killed. The buffers of runs with ``keep_buffer=true`` are not among them, nor the
    checkpoints of a run with epochs to go, nor unfinished files that were written to in the last ten minutes.

    Args:
        folder: of a run or of many, at any depth.

    Raises:
        ValueError: there is no such folder.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     list(find_waste(folder))
        []
    """
    root = Path(folder)
    if not root.is_dir():
        raise ValueError(f"{root} is no folder")
    for path in sorted({root, *(path for path in root.rglob("*") if path.is_dir())}):
        home = RunFolder(path)
        for part in home.parts:
            if part.is_file() and time.time() - part.stat().st_mtime > _AT_REST:
                yield Waste(part, "unfinished file", part.stat().st_size)
        if _has_ended(home):
            yield from _of_finished(home)


def _has_ended(home: RunFolder) -> bool:
    try:
        return home.is_done
    except ValueError:  # its configuration or its table is damaged: nobody knows
        return False


def _of_finished(home: RunFolder) -> Iterator[Waste]:
    for path in home.older_checkpoints:
        yield Waste(path, "older checkpoint", path.stat().st_size)
    if home.recipe().run.keep_buffer or not home.checkpoint.is_file():
        return
    try:
        state = load_checkpoint(home.checkpoint)
    except CheckpointError:  # it is of no use, but the only one there is
        return
    size = _bytes(state) - _bytes(without_buffer(state))
    if size:
        yield Waste(home.checkpoint, "replay buffer", size)


def _bytes(value: Any) -> int:
    """The bytes of all tensors in nested plain data."""
    if isinstance(value, Tensor):
        return value.nbytes
    if isinstance(value, dict):
        value = list(value.values())
    return sum(map(_bytes, value)) if isinstance(value, list | tuple) else 0
