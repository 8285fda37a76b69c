"""The class :class:`GoalMap`, histograms of a run's virtual goals and of their target, and its file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import torch
from torchrl.data import TensorDictReplayBuffer

from torchrl_her.files.writing import written
from torchrl_her.goals.ibs import GoalHistogram

_LARGEST = 1 << 27  # largest size of the arrays in a file, in bytes


@dataclass(frozen=True)
class GoalMap:
    """Histograms of virtual goals over a grid with n cells along each of the goals' one to three coordinates.

    Attributes:
        counts: numbers of virtual goals that each run has written since its buffer was last emptied: [R, n,
            n] for goals of two coordinates, where the first index is x and the second is y.
        target: q* at the final sigma, [n, n].
    """

    counts: np.ndarray
    target: np.ndarray

    @property
    def share(self) -> np.ndarray:
        """Distribution q [n, n] of virtual goals over the cells, averaged over the runs."""
        totals = self.counts.sum(tuple(range(1, self.counts.ndim)), keepdims=True)
        return (self.counts / np.maximum(totals, 1)).mean(0)

    def save(self, path: Path) -> None:
        """Writes the map to a file of numpy arrays (``.npz``)."""
        with written(path) as part:
            np.savez_compressed(part, counts=self.counts, target=self.target)

    @classmethod
    def load(cls, path: Path) -> GoalMap:
        """Reads a map from a file that :meth:`save` wrote.

        Raises:
            ValueError: the file is damaged, or missing because the run has written no virtual goals.
        """
        if not path.is_file():
            raise ValueError(f"{path.parent} has no {path.name}: the run has written no virtual goals")
        return cls.of(path, read_arrays(path))

    @classmethod
    def of(cls, path: Path, arrays: Mapping[str, np.ndarray], prefix: str = "") -> GoalMap:
        """Makes a map from the arrays of a file whose names are ``counts`` and ``target`` after a prefix.

        Raises:
            ValueError: arrays are missing, or do not form a map; the message names the file.
        """
        counts, target = arrays.get(f"{prefix}counts"), arrays.get(f"{prefix}target")
        if counts is None or target is None or counts.ndim < 2 or counts.shape[1:] != target.shape:
            got = [None if array is None else list(array.shape) for array in (counts, target)]
            raise ValueError(
                f"{path} is damaged: it must hold counts of the shape [runs, *target], got {got}"
            )
        return cls(counts, target)


def goal_map(buffer: TensorDictReplayBuffer, target: torch.Tensor | None) -> GoalMap | None:
    """Makes the map from a buffer's goal weights, which count goals, and q* [cells]; None without counts."""
    counted = [weights for weights in buffer.writer.goal_weights if isinstance(weights, GoalHistogram)]
    if not counted or target is None:
        return None
    shape = counted[0].grid.shape
    counts = torch.stack([histogram.counts.view(shape) for histogram in counted])
    return GoalMap(counts.cpu().numpy(), target.view(shape).cpu().numpy())


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Reads the arrays of an ``.npz`` file by name; raises a ValueError if they are not arrays of numbers."""
    with open(path, "rb") as file:
        try:
            with ZipFile(file) as archive:
                size = sum(record.file_size for record in archive.infolist())
            if size > _LARGEST:
                raise ValueError(f"its arrays take {size:,} bytes, more than {_LARGEST:,}")
            file.seek(0)
            arrays = dict(np.load(file, allow_pickle=False))
            if odd := [name for name, array in arrays.items() if array.dtype.kind not in "biuf"]:
                raise ValueError(f"{odd[0][:80]!r} holds no numbers")
            return arrays
        except Exception as error:  # damaged files raise errors of many types, from zlib to Python's parser
            why = str(error) if type(error) is ValueError else f"it holds no arrays ({type(error).__name__})"
            raise ValueError(f"{path} is damaged: {why}") from error
