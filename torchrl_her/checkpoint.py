"""Checkpoints of a whole run: atomic, checksummed, tensors and plain data only."""

from __future__ import annotations

import hashlib
import os
import pickle
import warnings
from collections import OrderedDict
from itertools import pairwise
from pathlib import Path
from typing import Any, BinaryIO

import torch
from tensordict import TensorDict
from torch import Tensor
from torch.utils.serialization import config
from torchrl.collectors import BaseCollector
from torchrl.data import TensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import PrioritizedSampler

_MAGIC = b"torchrl-her checkpoint 1\n"
_PIECE = 1 << 26  # bytes that are written before they are put onto the disk
_BODY = len(_MAGIC) + hashlib.sha256().digest_size  # where it begins


_PLAIN = (bool, int, float, complex, str, bytes, type(None), torch.Size, torch.dtype, torch.device)


class CheckpointError(ValueError):
    """A file that is no whole checkpoint."""


class _Stream:
    """What torch.save writes to: a file, and the checksum of what went into it."""

    def __init__(self, file: BinaryIO) -> None:
        self.file, self.hash = file, hashlib.sha256()
        self.flush = file.flush
        self._waiting = 0

    def write(self, data: bytes) -> int:
        self.hash.update(data)
        written = self.file.write(data)
        self._waiting += written
        if self._waiting >= _PIECE:
            self.sync()
        return written

    def sync(self) -> None:
        """Puts what was written onto the disk, and frees its memory: filling ever more of it takes longer."""
        self.file.flush()
        os.fsync(self.file.fileno())
        if hasattr(os, "posix_fadvise"):
            os.posix_fadvise(self.file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
        self._waiting = 0


def save_checkpoint(state: dict[str, Any], path: str | Path, *, keep: int = 1) -> None:
    """Writes a checkpoint so that the file is always whole: the new one or the one before.

    Args:
        state: nested dicts and lists of tensors and plain data.
        path: the file; a temporary one beside it is renamed to it when it is on the disk.

    Keyword Args:
        keep: how many there are in the end: ``checkpoint.pt`` is the newest, ``checkpoint.1.pt`` the one
            before it, and so on.

    Raises:
        TypeError: something in it is neither a tensor nor plain data, and could not be read again.
        OSError: it cannot be written; what was there before is untouched.
    """
    _check_plain(state, "the state")
    path = Path(path)
    part = path.with_name(path.name + ".part")
    try:
        with open(part, "wb") as file:
            _write(state, file)
        for newer, older in reversed(list(pairwise(_generations(path, keep)))):
            if newer.exists():
                os.replace(newer, older)
        os.replace(part, path)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        part.unlink(missing_ok=True)  # which it is if all went well; on a full disk it would be in the way
    _sync_folder(path.parent)


def _check_plain(value: Any, name: str) -> None:
    """Raises a TypeError that names what a safe load would refuse."""
    if type(value) in (dict, OrderedDict):
        for key, entry in value.items():
            _check_plain(entry, f"{name}[{key!r}]")
    elif type(value) in (list, tuple):
        for index, entry in enumerate(value):
            _check_plain(entry, f"{name}[{index}]")
    elif not isinstance(value, Tensor) and type(value) not in _PLAIN:  # numpy's floats are floats, too
        raise TypeError(f"{name} must be a tensor or plain data, got {type(value).__name__} {value!r}")


def _write(state: dict[str, Any], file: BinaryIO) -> None:
    """Mark, checksum and torch's file, down to the disk. It is in memory at no time."""
    file.write(_MAGIC.ljust(_BODY, b"\0"))
    stream = _Stream(file)
    try:
        # A second checksum would take half as long as the first.
        with config.patch("save.compute_crc32", False):  # type: ignore[attr-defined]
            torch.save(state, stream)  # type: ignore[arg-type]
    except RuntimeError as error:
        if isinstance(error.__context__, OSError):  # torch hides why it could not write
            raise error.__context__ from None
        raise
    file.seek(len(_MAGIC))
    file.write(stream.hash.digest())
    stream.sync()


def _generations(path: Path, keep: int) -> list[Path]:
    """The names of a checkpoint and of those before it, the newest first."""
    return [path, *(path.with_name(f"{path.stem}.{age}{path.suffix}") for age in range(1, keep))]


def _sync_folder(folder: Path) -> None:
    """Lets the renaming of files outlive a loss of power."""
    if os.name == "posix":  # elsewhere a folder cannot be opened
        number = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(number)
        finally:
            os.close(number)


def load_checkpoint(path: str | Path) -> dict[str, Any]:
    """Reads a checkpoint. Nothing in the file is ever executed.

    Args:
        path: a file that :func:`save_checkpoint` wrote.

    Raises:
        CheckpointError: it is not whole, not a checkpoint, or holds more than tensors and plain data.
        OSError: it cannot be read.
    """
    with open(path, "rb") as file:
        if file.read(len(_MAGIC)) != _MAGIC:
            raise CheckpointError(f"{path} is not a checkpoint of torchrl-her")
        digest = file.read(_BODY - len(_MAGIC))
        if hashlib.file_digest(file, "sha256").digest() != digest:
            raise CheckpointError(f"{path} is damaged: its checksum does not match")
        file.seek(_BODY)
        try:
            return torch.load(file, weights_only=True)
        except pickle.UnpicklingError as error:
            raise CheckpointError(f"{path} holds more than tensors and plain data") from error
        except Exception as error:  # of any type: whoever makes the checksum can put anything behind it
            reason = str(error).split("\n")[0]
            raise CheckpointError(f"{path} cannot be read: {reason}") from error


def load_newest_checkpoint(path: str | Path, *, keep: int = 2) -> dict[str, Any]:
    """Reads the newest whole checkpoint, and warns if there was a newer one.

    Args:
        path: as given to :func:`save_checkpoint`.

    Keyword Args:
        keep: likewise.

    Raises:
        CheckpointError: there are some, but none is whole.
        OSError: there is none, or it cannot be read.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     for epoch in (1, 2):
        ...         save_checkpoint({"epoch": epoch}, f"{folder}/checkpoint.pt", keep=2)
        ...     load_newest_checkpoint(f"{folder}/checkpoint.pt")
        {'epoch': 2}
    """
    path, damage = Path(path), []
    for own in [file for file in _generations(path, keep) if file.exists()] or [path]:
        try:
            state = load_checkpoint(own)
        except CheckpointError as error:
            damage.append(str(error))
            continue
        if damage:
            warnings.warn(f"{'; '.join(damage)}; {own.name}, the one before, is used instead", stacklevel=2)
        return state
    raise CheckpointError("; ".join(damage))


def collector_state_dict(collector: BaseCollector) -> dict[str, Any]:
    """Where a collector stands between two batches, without its policy: counters and half-played episodes.

    TorchRL's own state leaves out the episodes, as most environments cannot go on with them. Where
    the environment can be put back too, a run goes on from here exactly. Collectors over several
    processes keep their episodes to themselves: with them it goes on with new ones.
    """
    state = {name: value for name, value in collector.state_dict().items() if name != "policy_state_dict"}
    carrier = getattr(collector, "_carrier", None)
    return {**state, "carrier": None if carrier is None else carrier.clone().to_dict()}


def load_collector_state_dict(collector: BaseCollector, state: dict[str, Any]) -> None:
    """Puts a collector of the same make to where :func:`collector_state_dict` was taken."""
    own = {name: value for name, value in state.items() if name != "carrier"}
    if state.get("carrier") is None:
        collector.load_state_dict(own)
        return
    collector.load_state_dict(own, strict=False)  # its policy stays
    carrier = collector._carrier
    shown = TensorDict.from_dict(state["carrier"], batch_size=carrier.batch_size)
    collector._carrier = carrier.empty().update(shown)
    if "traj_pool" in own:  # TorchRL has drawn new ids, but the episodes have theirs
        collector._traj_pool.load_state_dict(own["traj_pool"])


def buffer_state_dict(buffer: TensorDictReplayBuffer, *, copy: bool = True) -> dict[str, Any]:
    """What a replay buffer holds: filled rows, writer, and priorities if it has any.

    TorchRL's own state holds the whole capacity, and for a prioritised sampler objects that a safe
    load refuses.

    Args:
        buffer: the buffer.

    Keyword Args:
        copy: whether the rows are copied. Without it they are only good for being written at once.
    """
    n = len(buffer)
    rows = buffer.storage[:] if n else None  # as stored, without what transforms add
    state: dict[str, Any] = {
        "rows": None if rows is None else rows.apply(torch.clone if copy else _alone).to_dict(),
        "shape": [] if rows is None else list(rows.batch_size),
        "size": n,
        "capacity": _capacity(buffer),
        "writer": buffer.writer.state_dict(),
        "sampler": None,
    }
    if isinstance(buffer.sampler, PrioritizedSampler):
        sampler = buffer.sampler.state_dict()
        filled = torch.arange(n)
        state["sampler"] = {
            "sum": torch.as_tensor(sampler["_sum_tree"][filled]) if n else None,
            "min": torch.as_tensor(sampler["_min_tree"][filled]) if n else None,
            "max_priority": [
                None if value is None else torch.as_tensor(value) for value in sampler["_max_priority"]
            ],
        }
    return state


def _capacity(buffer: TensorDictReplayBuffer) -> int:
    """Rows that fit; 0 for storages of several dimensions, which round it up when they are first written."""
    return buffer.storage.max_size if buffer.storage.ndim == 1 else 0


def _alone(rows: Tensor) -> Tensor:
    """Rows of a longer tensor, in the same memory: torch.save would write the other rows, too."""
    if not rows.is_contiguous():
        return rows.clone()
    start = rows.storage_offset() * rows.itemsize
    own = rows.untyped_storage()[start : start + rows.nbytes]
    return torch.empty(0, dtype=rows.dtype, device=rows.device).set_(own, 0, rows.shape, rows.stride())


def load_buffer_state_dict(buffer: TensorDictReplayBuffer, state: dict[str, Any]) -> None:
    """Fills an empty buffer of the same make with what :func:`buffer_state_dict` gave.

    Raises:
        ValueError: the buffer holds rows already, has another capacity, or another kind of sampler.
    """
    n, capacity = state["size"], _capacity(buffer)
    if len(buffer):
        raise ValueError(f"the buffer must be empty, it holds {len(buffer):,} rows")
    if capacity != state["capacity"]:
        raise ValueError(f"the state is that of a buffer of {state['capacity']:,} rows, not of {capacity:,}")
    if isinstance(buffer.sampler, PrioritizedSampler) != (state["sampler"] is not None):
        whose = "without priorities" if state["sampler"] is None else "with priorities"
        raise ValueError(f"the state is that of a sampler {whose}, not of a {type(buffer.sampler).__name__}")
    if n:
        rows = TensorDict.from_dict(state["rows"], batch_size=state["shape"])
        buffer.storage.set(torch.arange(len(rows)), rows)
    buffer.writer.load_state_dict(state["writer"])
    if state["sampler"] is not None:
        sampler = buffer.sampler.state_dict()
        filled = torch.arange(n)
        if n:
            sampler["_sum_tree"][filled] = state["sampler"]["sum"]
            sampler["_min_tree"][filled] = state["sampler"]["min"]
        sampler["_max_priority"] = tuple(state["sampler"]["max_priority"])
        buffer.sampler.load_state_dict(sampler)
