"""Checkpoints of a whole run: written atomically, checksummed, and made of tensors and plain data only."""

from __future__ import annotations

import hashlib
import os
import warnings
from collections import OrderedDict
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any, BinaryIO

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch.utils.serialization import config
from torchrl.collectors import BaseCollector
from torchrl.data import TensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import PrioritizedSampler, Sampler, SamplerEnsemble
from torchrl.data.replay_buffers.storages import Storage

from torchrl_her.files.reading import MoreThanDataError, load_tensors
from torchrl_her.files.writing import written
from torchrl_her.replay_buffers.runs.buffer import bounds_of_run, runs_of, sizes_of
from torchrl_her.replay_buffers.runs.sampler import RunsPrioritizedSampler
from torchrl_her.replay_buffers.runs.storage import Field, PackedStorage, unpack
from torchrl_her.torchrl_private import (
    capacity_of,
    carrier_of,
    last_written,
    samplers_in,
    set_carrier,
    set_last_written,
    set_length,
    set_next_ids,
)

_MAGIC = b"torchrl-her checkpoint 1\n"
_PIECE = 1 << 26  # bytes between two syncs to disk
_BODY = len(_MAGIC) + hashlib.sha256().digest_size  # offset at which torch's file starts
_REMAINING = "_remaining_batches"  # key for the rest of a sampler's pass, which TorchRL's states lack
_PLAIN = (bool, int, float, str, type(None), torch.Size, torch.dtype)
# Functions that rebuild the tensors that a safe load accepts: dense ones, not nested, without attributes.
_DENSE = ("_rebuild_tensor_v2", "_rebuild_tensor_v3", "_rebuild_parameter")


class CheckpointError(ValueError):
    """A file is not a checkpoint, or is damaged."""


class _Stream:
    """Sink of ``torch.save``: writes to a file and computes a checksum."""

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
        """Syncs to disk and empties the page cache of the file, whose growth would slow down writing."""
        self.file.flush()
        os.fsync(self.file.fileno())
        if hasattr(os, "posix_fadvise"):
            os.posix_fadvise(self.file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
        self._waiting = 0


def save_checkpoint(state: dict[str, Any], path: str | Path, *, keep: int = 1) -> None:
    """Writes a checkpoint atomically: the file is always either the new checkpoint or the one before.

    Args:
        state: nested dicts and lists of tensors and plain data.
        path: the file. It is written under another name beside it and renamed when it is on the disk.

    Keyword Args:
        keep: number of checkpoints to keep: ``checkpoint.pt`` is the newest, ``checkpoint.1.pt`` the one
            before it, and so on.

    Raises:
        TypeError: something in ``state`` could not be loaded, since it is neither a dense tensor nor plain
            data; the message names it.
        OSError: the file cannot be written; the previous checkpoint is untouched.
    """
    _check_plain(state, "the state")
    path = Path(path)
    with written(path) as part:
        with open(part, "wb") as file:
            _write(state, file)
        for newer, older in reversed(list(pairwise(_generations(path, keep)))):
            if newer.exists():
                os.replace(newer, older)


def _check_plain(value: Any, name: str) -> None:
    """Raises a TypeError that names the first entry that a safe load would refuse."""
    if type(value) in (dict, OrderedDict):
        for key, entry in value.items():
            _check_plain(key, f"the key {key!r} of {name}")
            _check_plain(entry, f"{name}[{key!r}]")
    elif type(value) in (list, tuple):
        for index, entry in enumerate(value):
            _check_plain(entry, f"{name}[{index}]")
    elif isinstance(value, Tensor):
        for tensor in (value, value.data):  # a parameter is rebuilt from its data
            rebuild = tensor.__reduce_ex__(2)[0].__name__
            if rebuild not in _DENSE:
                kind = f"{type(value).__name__} (written as {rebuild})"
                raise TypeError(f"{name} must be a dense tensor without attributes, got {kind}")
    elif type(value) not in _PLAIN:  # numpy's floats pass isinstance
        raise TypeError(f"{name} must be a tensor or plain data, got {type(value).__name__} {value!r}")


def _write(state: dict[str, Any], file: BinaryIO) -> None:
    """Writes mark, checksum and torch's file to disk, without holding the file in memory."""
    file.write(_MAGIC.ljust(_BODY, b"\0"))
    stream = _Stream(file)
    try:
        # Turns off torch's own checksum, which would add half of the time of ours.
        with config.patch("save.compute_crc32", False):  # type: ignore[attr-defined]
            torch.save(state, stream)  # type: ignore[arg-type]
    except RuntimeError as error:
        if isinstance(error.__context__, OSError):  # torch hides the system's error, which names the reason
            raise error.__context__ from None
        raise
    file.seek(len(_MAGIC))
    file.write(stream.hash.digest())
    stream.sync()


def _generations(path: Path, keep: int) -> list[Path]:
    """Returns the paths of a checkpoint and its predecessors, the newest first."""
    return [path, *(path.with_name(f"{path.stem}.{age}{path.suffix}") for age in range(1, keep))]


def load_checkpoint(path: str | Path, *, map_location: torch.device | str = "cpu") -> dict[str, Any]:
    """Reads a checkpoint. Nothing in the file is executed.

    Args:
        path: a file that :func:`~torchrl_her.save_checkpoint` wrote.

    Keyword Args:
        map_location: device of the loaded tensors. The ``load_state_dict`` of a module copies them to the
            device of the module.

    Raises:
        CheckpointError: the file is damaged, not a checkpoint, or holds more than tensors and plain data.
        OSError: the file cannot be read.
    """
    with open(path, "rb") as file:
        if file.read(len(_MAGIC)) != _MAGIC:
            raise CheckpointError(f"{path} is not a checkpoint of torchrl-her")
        digest = file.read(_BODY - len(_MAGIC))
        if hashlib.file_digest(file, "sha256").digest() != digest:
            raise CheckpointError(f"{path} is damaged: its checksum does not match")
        file.seek(_BODY)
        try:
            return load_tensors(file, map_location=map_location)
        except MoreThanDataError as error:
            raise CheckpointError(f"{path} holds {error}") from error
        except ValueError as error:  # a file with a right checksum may still hold anything
            raise CheckpointError(f"{path} cannot be read: {error}") from error


def load_newest_checkpoint(path: str | Path, *, keep: int = 2) -> dict[str, Any]:
    """Reads the newest checkpoint that is not damaged, and warns if a newer one is damaged.

    Args:
        path: as given to :func:`~torchrl_her.save_checkpoint`.

    Keyword Args:
        keep: as given to :func:`~torchrl_her.save_checkpoint`.

    Raises:
        CheckpointError: all checkpoints are damaged.
        OSError: there is no checkpoint, or it cannot be read.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     for epoch in (1, 2):
        ...         save_checkpoint({"epoch": epoch}, f"{folder}/checkpoint.pt", keep=2)
        ...     load_newest_checkpoint(f"{folder}/checkpoint.pt")
        {'epoch': 2}
    """
    path, damage = Path(path), []
    for candidate in [file for file in _generations(path, keep) if file.exists()] or [path]:
        try:
            state = load_checkpoint(candidate)
        except CheckpointError as error:
            damage.append(str(error))
            continue
        if damage:
            warnings.warn(
                f"{'; '.join(damage)}; {candidate.name}, the one before, is used instead", stacklevel=2
            )
        return state
    raise CheckpointError("; ".join(damage))


def collector_state_dict(collector: BaseCollector) -> dict[str, Any]:
    """Returns the state of a collector between two batches, without its policy: counters and open episodes.

    TorchRL's own state leaves out open episodes, since most environments cannot continue them. If the
    environment's state is restored too, a run continues exactly. The open episodes of a collector in
    several processes cannot be read: after it is restored, it begins new ones.
    """
    state = {name: value for name, value in collector.state_dict().items() if name != "policy_state_dict"}
    carrier = carrier_of(collector)
    return {**state, "carrier": None if carrier is None else carrier.clone().to_dict()}


def load_collector_state_dict(collector: BaseCollector, state: dict[str, Any]) -> None:
    """Restores the state that :func:`~torchrl_her.trainers.collector_state_dict` returned.

    Args:
        collector: a collector made in the same way as the one that returned the state.
        state: the state, as returned or loaded from a file.
    """
    collector_state = {name: value for name, value in state.items() if name != "carrier"}
    if state["carrier"] is None:
        collector.load_state_dict(collector_state)
        return
    collector.load_state_dict(collector_state, strict=False)  # the state has no policy
    carrier: Any = carrier_of(collector)
    collected = TensorDict.from_dict(state["carrier"], batch_size=carrier.batch_size)
    set_carrier(collector, carrier.empty().update(collected))
    if "traj_pool" in collector_state:  # open episodes keep their ids; TorchRL drew new ones
        set_next_ids(collector, collector_state["traj_pool"])


def buffer_state_dict(buffer: TensorDictReplayBuffer, *, copy: bool = True) -> dict[str, Any]:
    """Returns the state of a replay buffer: stored transitions, writer and sampler.

    A restored buffer samples the same batches as an uninterrupted one, if the random numbers are the same.
    TorchRL's own state has the size of the whole capacity, and with a prioritized sampler it holds objects
    that a safe load refuses.

    Args:
        buffer: the buffer.

    Keyword Args:
        copy: whether the transitions are copied. If not, save the state before the buffer changes.
    """
    convert = torch.clone if copy else _alone
    blocks = [bounds_of_run(buffer, run) for run in range(runs_of(buffer))]
    state: dict[str, Any] = {
        "rows": [_block(buffer, *bounds, convert) for bounds in blocks],
        "blocks": blocks,
        "capacity": _capacity(buffer),
        "cursor": last_written(buffer.storage),
        "writer": buffer.writer.state_dict(),
        "sampler": sampler_state_dict(buffer.sampler, len(buffer)),
    }
    return state


def _block(
    buffer: TensorDictReplayBuffer, begin: int, end: int, convert: Callable[[Tensor], Tensor]
) -> dict[str, Any] | None:
    """Returns the stored rows from ``begin`` to ``end``, mapped by ``convert``; None if there are none."""
    storage = buffer.storage
    if begin == end:
        return None
    if isinstance(storage, PackedStorage) and storage.packed is not None:
        return {
            "packed": convert(storage.packed[begin:end]),
            "fields": [tuple(field) for field in storage.fields],
        }
    rows = storage[:] if storage.ndim > 1 else storage[begin:end]  # the buffer would transform them
    return {"entries": rows.apply(convert).to_dict(), "shape": list(rows.batch_size)}


def _capacity(buffer: TensorDictReplayBuffer) -> int:
    """Returns the capacity; 0 for storages of several dimensions, which round it up at the first write."""
    return buffer.storage.max_size if buffer.storage.ndim == 1 else 0


def _alone(rows: Tensor) -> Tensor:
    """Returns a view of rows whose storage has no other rows, since torch.save writes whole storages."""
    if not rows.is_contiguous():
        return rows.clone()
    start = rows.storage_offset() * rows.itemsize
    storage = rows.untyped_storage()[start : start + rows.nbytes]
    return torch.empty(0, dtype=rows.dtype, device=rows.device).set_(storage, 0, rows.shape, rows.stride())


def load_buffer_state_dict(buffer: TensorDictReplayBuffer, state: dict[str, Any]) -> None:
    """Restores the state that :func:`~torchrl_her.trainers.buffer_state_dict` returned.

    Args:
        buffer: an empty buffer, made in the same way as the one that returned the state.
        state: the state, as returned or loaded from a file.

    Raises:
        ValueError: the buffer is not empty, or has another capacity or another kind of sampler.
    """
    capacity = _capacity(buffer)
    if any(sizes_of(buffer)):
        raise ValueError(f"the buffer must be empty, it holds {sum(sizes_of(buffer)):,} rows")
    if capacity != state["capacity"]:
        raise ValueError(f"the state must have a capacity of {capacity:,} rows, got {state['capacity']:,}")
    load_sampler_state_dict(buffer.sampler, state["sampler"])
    if len(state["blocks"]) != runs_of(buffer):
        raise ValueError(f"the state must have {runs_of(buffer)} runs, got {len(state['blocks'])}")
    for (begin, end), block in zip(state["blocks"], state["rows"], strict=True):
        if block is not None:
            _load_block(buffer.storage, begin, end, block)
    if state["cursor"] is not None:  # slice samplers see here where the oldest row follows the newest
        set_last_written(buffer.storage, state["cursor"])
    buffer.writer.load_state_dict(state["writer"])


def _load_block(storage: Storage, begin: int, end: int, block: dict[str, Any]) -> None:
    """Restores the rows ``begin`` to ``end`` of a storage."""
    if "packed" in block:
        fields = [Field(*field) for field in block["fields"]]
        if isinstance(storage, PackedStorage) and storage.restore(begin, block["packed"], fields):
            return
        rows: TensorDictBase = unpack(block["packed"], fields)
    else:
        rows = TensorDict.from_dict(block["entries"], batch_size=block["shape"])
    place = torch.arange(begin, begin + len(rows))
    if begin == 0:
        storage.set(place, rows)
    else:
        storage.set(place, rows, set_cursor=False)
        set_length(storage, end)


def sampler_state_dict(sampler: Sampler, size: int) -> dict[str, Any]:
    """Returns the state that decides, together with random numbers, which rows a sampler draws next.

    For a prioritized sampler it holds the priorities of the first ``size`` rows only, which are filled.
    """
    if isinstance(sampler, SamplerEnsemble):
        # The trees of an ensemble are saved whole, since the numbers of filled rows are not known here.
        state: dict[str, Any] = {
            str(i): sampler_state_dict(part, capacity_of(part)) for i, part in enumerate(samplers_in(sampler))
        }
    elif isinstance(sampler, PrioritizedSampler) and not isinstance(sampler, RunsPrioritizedSampler):
        state = _priorities(sampler, size)
    else:
        state = {
            key: value.clone() if isinstance(value, Tensor) else value
            for key, value in sampler.state_dict().items()
        }
    return {"kind": type(sampler).__name__, "own": state, "remaining": vars(sampler).get(_REMAINING)}


def load_sampler_state_dict(sampler: Sampler, state: dict[str, Any]) -> None:
    """Restores the state that :func:`sampler_state_dict` returned.

    Raises:
        ValueError: the state is of another kind of sampler.
    """
    kind = type(sampler).__name__
    if state["kind"] != kind:
        raise ValueError(f"the state must be of a {kind}, got a {state['kind']}")
    if isinstance(sampler, SamplerEnsemble):
        for i, part in enumerate(samplers_in(sampler)):
            load_sampler_state_dict(part, state["own"][str(i)])
    elif isinstance(sampler, PrioritizedSampler) and not isinstance(sampler, RunsPrioritizedSampler):
        _load_priorities(sampler, state["own"])
    else:
        sampler.load_state_dict(state["own"])
    if state["remaining"] is not None:
        setattr(sampler, _REMAINING, state["remaining"])


def _priorities(sampler: PrioritizedSampler, size: int) -> dict[str, Any]:
    """Returns the priorities of filled rows: TorchRL's state holds trees that a safe load refuses."""
    state, filled = sampler.state_dict(), torch.arange(size)
    return {
        "sum": torch.as_tensor(state["_sum_tree"][filled]) if size else None,
        "min": torch.as_tensor(state["_min_tree"][filled]) if size else None,
        "max_priority": [
            None if value is None else torch.as_tensor(value) for value in state["_max_priority"]
        ],
        "alpha": float(state["_alpha"]),
        "beta": float(state["_beta"]),
    }


def _load_priorities(sampler: PrioritizedSampler, saved: dict[str, Any]) -> None:
    state = sampler.state_dict()
    if saved["sum"] is not None:
        filled = torch.arange(len(saved["sum"]))
        state["_sum_tree"][filled] = saved["sum"]
        state["_min_tree"][filled] = saved["min"]
    state["_max_priority"] = tuple(saved["max_priority"])
    state["_alpha"], state["_beta"] = saved["alpha"], saved["beta"]
    sampler.load_state_dict(state)
