"""Access to single runs in a replay buffer of one or several runs."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDictBase
from torchrl.data import ReplayBuffer

from torchrl_her.torchrl_private import count_a_write


def runs_of(buffer: ReplayBuffer) -> int:
    """Returns the number of runs of a buffer's writer; 1 if the writer has no runs."""
    return getattr(buffer.writer, "runs", 1)


def sizes_of(buffer: ReplayBuffer) -> list[int]:
    """Returns the number of rows of each run that can be sampled from a buffer."""
    return [len(buffer)] if runs_of(buffer) == 1 else buffer.writer.sizes


def rows_of_run(buffer: ReplayBuffer, run: int = 0) -> TensorDictBase:
    """Returns a run's stored rows [n], in the order of its block, as a view.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
        >>> buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(3))
        >>> _ = buffer.extend(TensorDict({"x": torch.tensor([5.0, 6.0])}, [2]))
        >>> rows_of_run(buffer)["x"].tolist()
        [5.0, 6.0]
    """
    begin, end = bounds_of_run(buffer, run)
    return buffer.storage[begin:end]


def bounds_of_run(buffer: ReplayBuffer, run: int) -> tuple[int, int]:
    """Returns the first row of a run's block in the storage, and one more than its last row."""
    _check(buffer, run)
    if runs_of(buffer) == 1:
        return 0, len(buffer.storage)
    begin = run * buffer.writer.capacity
    return begin, begin + sizes_of(buffer)[run]


def empty_run(buffer: ReplayBuffer, run: int = 0) -> None:
    """Empties one run's block: rows, priorities, counts, weights of goals and open episodes.

    Args:
        buffer: buffer of several runs, or of a single one, which is emptied as a whole.
        run: index of the run, from 0.

    Raises:
        ValueError: there is no such run.
    """
    _check(buffer, run)
    if runs_of(buffer) == 1:
        buffer.empty()
        return
    writer: Any = buffer.writer
    sampler: Any = buffer.sampler
    writer.empty_run(run)
    sampler.empty_run(run)
    count_a_write(buffer.storage)


def _check(buffer: ReplayBuffer, run: int) -> None:
    if not 0 <= run < runs_of(buffer):
        raise ValueError(f"run must be in [0, {runs_of(buffer) - 1}], got {run}")
