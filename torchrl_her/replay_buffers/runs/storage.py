"""A storage that keeps all entries of a transition side by side in memory."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, is_leaf_nontensor, is_non_tensor
from torch import Tensor
from torchrl.data.replay_buffers.storages import LazyTensorStorage, TensorStorage

from torchrl_her.torchrl_private import count_a_write, set_last_written, set_length, whole_of

_ALIGNED = 8  # alignment of rows in bytes, so that numbers of any type can be read in place


class Field(NamedTuple):
    """Position of an entry within a packed row."""

    key: NestedKey
    dtype: torch.dtype
    shape: torch.Size  # shape of the entry in a row
    begin: int  # bytes from the beginning of the row
    end: int


class Move(NamedTuple):
    """Slice of new rows, and the slice of the storage that they are copied to."""

    source: slice
    to: slice


class PackedStorage(LazyTensorStorage):
    """TorchRL's ``LazyTensorStorage``, with all entries of a transition side by side in memory.

    Drawing a row then takes one access to memory, and not one for each entry, which makes it many times as
    fast: rows are drawn from all over a storage that is larger than any cache. Entries that are read are
    views of the drawn rows, so their memory is not contiguous. Everything else is as in
    ``LazyTensorStorage``, which also stores what cannot be packed: entries that are no
    tensors, nested tensordicts that are empty or have another batch size, and tensors instead of tensordicts.
    If later rows have new entries, the storage is copied once to pack these, too.

    Args:
        max_size: number of rows.

    Keyword Args:
        device: device of the rows.

    Example:
        >>> storage = PackedStorage(4)
        >>> storage.set(slice(0, 2), TensorDict({"x": torch.tensor([[1.0], [2.0]]), "y": torch.eye(2)}, [2]))
        >>> rows = storage.get(torch.tensor([1, 1, 0]))
        >>> rows["x"].flatten().tolist(), rows["y"].tolist()
        ([2.0, 2.0, 1.0], [[0.0, 1.0], [0.0, 1.0], [1.0, 0.0]])
    """

    device: Any  # "auto" until there are rows
    initialized: bool

    def __init__(self, max_size: int, *, device: torch.device | str = "cpu") -> None:
        super().__init__(max_size, device=device)
        self._packed: Tensor | None = None  # [max_size, bytes / 8] of int64
        self._views: TensorDictBase | None = None  # the same memory, entry by entry
        self.fields: tuple[Field, ...] = ()  # position of each entry within a row
        self._number = 0  # number of keys of the views, nested keys included

    @property
    def packed(self) -> Tensor | None:
        """All rows as [max_size, m] of int64, whatever the types of entries; None if they are not packed."""
        return self._packed if self._packed is not None and self._storage is self._views else None

    def get(self, index: int | Sequence[int] | slice) -> Any:
        packed = self.packed
        if packed is None or not isinstance(index, Tensor) or index.dtype != torch.int64 or index.ndim != 1:
            return super().get(index)
        # A full storage needs no check of the indices: there is no row after the last one.
        length = self._len
        if length < self.max_size and len(index) and int(index.max()) >= length:
            return super().get(index)  # the parent class raises an error
        try:
            rows = packed.index_select(0, index)
        except IndexError:  # negative numbers count from the end
            return super().get(index)
        return unpack(rows, self.fields)

    def set(self, cursor: Any, data: Any, *, set_cursor: bool = True) -> None:
        super().set(cursor, data, set_cursor=set_cursor)
        if self.packed is not None and _number_of_keys(self._storage) != self._number:
            self._pack()  # rows came with new entries, which are not among the packed ones

    def _init_standard(self, data: Any) -> None:
        """Allocates the storage for rows like the given one."""
        fields = layout(torch.empty_like(data).unsqueeze(0)) if isinstance(data, TensorDictBase) else ()
        if not fields:
            super()._init_standard(data)
            return
        if self.device == "auto":
            self.device = data.device
        self._allocate(fields, self.device)
        self.initialized = True

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        super().load_state_dict(state_dict)
        self._pack()

    def loads(self, path: str | Path) -> None:
        super().loads(path)
        if self.packed is None:
            self._pack()

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        if self._packed is not None and self.packed is not None:
            # The entries of a copy have memory of their own, so they are made views of the packed rows again.
            self._storage = self._views = unpack(self._packed, self.fields)

    def restore(self, begin: int, packed: Tensor, fields: Sequence[Field]) -> bool:
        """Copies packed rows [n, m] to ``begin``; returns False if this storage has another layout."""
        if not self.initialized:
            self._allocate(tuple(fields), packed.device if self.device == "auto" else self.device)
            self.initialized = True
        if self.packed is None or self.fields != tuple(fields):
            return False
        self.packed[begin : begin + len(packed)] = packed
        self._len = max(self._len, begin + len(packed))  # type: ignore[has-type]
        self._bump_mutation_revision()
        return True

    def _allocate(self, fields: tuple[Field, ...], device: torch.device | None) -> None:
        width = -(-fields[-1].end // _ALIGNED)
        self.fields = fields
        # Zeros, so that the bytes between rows are the same in every checkpoint. On the CPU NumPy makes them,
        # since its zeros take memory only when rows are written; torch.zeros takes all memory at once.
        if device is None or device.type == "cpu":
            self._packed = torch.from_numpy(np.zeros((self.max_size, width), np.int64))
        else:
            self._packed = torch.zeros(self.max_size, width, dtype=torch.int64, device=device)
        self._storage = self._views = unpack(self._packed, fields)
        self._number = _number_of_keys(self._views)

    def _pack(self) -> None:
        """Replaces the storage by a packed one with the same rows, unless they cannot be packed."""
        self._packed = self._views = None
        rows = self._storage
        fields = layout(rows[:1]) if isinstance(rows, TensorDictBase) else ()
        if not fields:
            return
        self._allocate(fields, rows.device)
        self._storage.update_(rows)


def write_slices(storage: TensorStorage, rows: TensorDictBase, moves: Sequence[Move]) -> None:
    """Writes rows [m] into a storage of one dimension, slice by slice, and updates its length."""
    entries = dict(rows.items(True, True))
    kept = dict(whole_of(storage).items(True, True)) if storage.initialized else {}
    if kept.keys() != entries.keys():  # also at the first write, which makes the storage
        for move in moves:
            storage.set(move.to, rows[move.source], set_cursor=False)
    else:  # entry by entry: slicing a tensordict takes longer than copying it
        for key, entry in entries.items():
            for source, to in moves:
                kept[key][to] = entry[source]
        count_a_write(storage)
    if moves:
        set_last_written(storage, moves[-1].to)
        set_length(storage, max(len(storage), *(move.to.stop for move in moves)))


def layout(rows: TensorDictBase) -> tuple[Field, ...]:
    """Computes the positions of entries in packed rows, largest types first; empty if rows cannot be packed.

    Example:
        >>> rows = TensorDict({"x": torch.zeros(1, 3), "done": torch.zeros(1, 1, dtype=torch.bool)}, [1])
        >>> [(field.key, field.begin, field.end) for field in layout(rows)]
        [('x', 0, 12), ('done', 12, 13)]
    """
    entries = []
    for key, entry in rows.items(True, is_leaf=is_leaf_nontensor):
        if isinstance(entry, Tensor) and entry.layout is torch.strided and entry.numel() > 0:
            entries.append((key, entry))
        elif not _is_plain_node(entry, rows.batch_size):
            return ()
    if rows.ndim != 1:
        return ()
    out: list[Field] = []
    begin = 0
    # Largest types come first, so that all are aligned; keys are sorted, so that the layout never varies.
    for key, entry in sorted(entries, key=lambda pair: (-pair[1].itemsize, _path(pair[0]))):
        size = entry[0].numel() * entry.itemsize
        out.append(Field(key, entry.dtype, entry.shape[1:], begin, begin + size))
        begin += size
    return tuple(out)


def unpack(packed: Tensor, fields: Sequence[Field]) -> TensorDict:
    """Returns packed rows [n, m] of int64 as a tensordict [n] of views."""
    shape, device = packed.shape[:1], packed.device
    typed: dict[torch.dtype, Tensor] = {}
    source: dict[Any, Any] = {}
    for key, dtype, entry_shape, begin, end in fields:
        if dtype not in typed:
            typed[dtype] = packed.view(dtype) if dtype != torch.bool else packed.view(torch.uint8).view(dtype)
        size = dtype.itemsize
        entry = typed[dtype][:, begin // size : end // size]
        if len(entry_shape) != 1:
            entry = entry.unflatten(1, entry_shape) if entry_shape else entry.squeeze(1)
        *path, last = _path(key)
        target = source
        for part in path:
            target = target.setdefault(part, {})
        target[last] = entry
    return _tensordict(source, shape, device)


def _tensordict(source: dict[Any, Any], shape: torch.Size, device: torch.device) -> TensorDict:
    """Makes a tensordict of tensors of the right shape without checks, which take most of the time."""
    entries = {
        key: _tensordict(entry, shape, device) if isinstance(entry, dict) else entry
        for key, entry in source.items()
    }
    return TensorDict._new_unsafe(source=entries, batch_size=shape, device=device)


def _is_plain_node(entry: Any, shape: torch.Size) -> bool:
    """Returns whether an entry is a nested tensordict that can be rebuilt from the keys of its tensors."""
    if not isinstance(entry, TensorDictBase) or is_non_tensor(entry):
        return False
    return entry.batch_size == shape and not entry.is_empty()


def _number_of_keys(rows: TensorDictBase) -> int:
    """Counts keys, nested keys included."""
    return len(list(rows.keys(True, is_leaf=is_leaf_nontensor)))


def _path(key: NestedKey) -> tuple[str, ...]:
    return (key,) if isinstance(key, str) else tuple(key)
