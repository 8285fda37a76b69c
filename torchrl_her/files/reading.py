"""Reading what ``torch.save`` wrote, without its unpickler: tensors and plain data, and nothing else.

``torch.load(weights_only=True)`` executes nothing either, but a small file can make it take any amount of
memory (torch 2.14.1: it unpacks compressed records, so that 0.2 MB become 200 MB, and a ``bytearray`` as
long as a file says, 2 GB for one of a kilobyte). Here every size is compared with what is there before memory
is taken for it.
"""

from __future__ import annotations

import math
import pickletools
import struct
import sys
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple
from zipfile import ZIP_STORED, BadZipFile, ZipFile

import torch
from torch import Tensor, nn

_STEPS = 1 << 22  # of a file's description: they take a few hundred megabytes at most
_SHARED = 16  # how often entries are shared, on average over the steps
_DESCRIPTION = 1 << 26  # bytes of it
_DEPTH = 100
_WIDENED = 1 << 24  # numbers of all tensors that repeat what they store
_LOCAL = struct.Struct("<4s22xHH")  # of a record: its mark, and the lengths of its name and of what follows
_DTYPES = {name: own for name in dir(torch) if isinstance(own := getattr(torch, name), torch.dtype)}
_STORAGES = {
    "Bool": torch.bool,
    "Byte": torch.uint8,
    "Char": torch.int8,
    "Short": torch.int16,
    "Int": torch.int32,
    "Long": torch.int64,
    "Half": torch.float16,
    "BFloat16": torch.bfloat16,
    "Float": torch.float32,
    "Double": torch.float64,
    "ComplexFloat": torch.complex64,
    "ComplexDouble": torch.complex128,
}


class MoreThanDataError(ValueError):
    """A file names something that is neither a tensor nor plain data."""


class _RefusedError(ValueError):
    """What a file says of itself cannot be; the message says what."""


class _Storage(NamedTuple):
    """Numbers that tensors are views of; ``dtype`` is None if the tensor says it."""

    data: torch.UntypedStorage
    dtype: torch.dtype | None


def read_tensors(path: str | Path) -> Any:
    """What ``torch.save`` wrote, if it is tensors and plain data.

    Args:
        path: the file.

    Raises:
        ValueError: the file is damaged or holds something else; the message names it.
        OSError: it cannot be read.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     torch.save({"weights": torch.arange(3)}, f"{folder}/mine.pt")
        ...     read_tensors(f"{folder}/mine.pt")
        {'weights': tensor([0, 1, 2])}
    """
    with open(path, "rb") as file:
        try:
            return load_tensors(file)
        except MoreThanDataError as error:
            raise ValueError(f"{path} holds {error}") from error
        except ValueError as error:
            raise ValueError(f"{path} cannot be read: {error}") from error


def load_tensors(file: BinaryIO, *, map_location: torch.device | str = "cpu") -> Any:
    """The same of an open file, which may begin with something else.

    Args:
        file: that can be read anywhere.

    Keyword Args:
        map_location: where its tensors come, wherever they were.

    Raises:
        MoreThanDataError: the file names something else; the message goes on after "the file holds".
        ValueError: it is damaged; the message goes on after "the file cannot be read:".
    """
    try:
        archive = _Archive(file)
        machine = _Machine(archive, torch.device(map_location))
        loaded = machine.run(archive.description())
        _check_tree(loaded, most=_SHARED * machine.steps + 1_000)
        return loaded
    except (MoreThanDataError, _RefusedError):
        raise
    except Exception as error:  # of any type: steps of a damaged description may ask for anything
        raise ValueError(f"its description is damaged ({type(error).__name__})") from error


class _Archive:
    """The records of a file. None of them is compressed, so all of them together are no larger than it."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._size = file.seek(0, 2)
        try:
            with ZipFile(file) as archive:
                records = archive.infolist()
        except (BadZipFile, NotImplementedError, EOFError, OSError, struct.error) as error:
            raise _RefusedError("it is damaged, or no archive of tensors") from error
        if strange := [own.filename for own in records if own.compress_type != ZIP_STORED]:
            raise _RefusedError(f"its record {strange[0][:80]!r} is compressed")
        if sum(own.file_size for own in records) > self._size:
            raise _RefusedError(f"its records are larger than its {self._size:,} bytes")
        self._places = {own.filename: (own.header_offset, own.file_size) for own in records}
        if len(self._places) < len(records):
            raise _RefusedError("two of its records have the same name")
        described = [name for name in self._places if name.endswith("/data.pkl") and name.count("/") == 1]
        if len(described) != 1:
            raise _RefusedError("it is no archive of tensors: it has no description of them")
        self._root = described[0].removesuffix("data.pkl")
        order = self._root + "byteorder"
        if order in self._places and self.read(order).numpy().tobytes() != sys.byteorder.encode():
            raise _RefusedError(f"its numbers are not in the order of bytes of this machine, {sys.byteorder}")

    def description(self) -> bytes:
        """The pickle of what the file holds."""
        if (size := self._places[self._root + "data.pkl"][1]) > _DESCRIPTION:
            raise _RefusedError(f"its description has {size:,} bytes, more than {_DESCRIPTION:,}")
        return self.read(self._root + "data.pkl").numpy().tobytes()

    def storage(self, key: str, size: int) -> torch.UntypedStorage:
        """The numbers of a storage, which take so many bytes."""
        name = f"{self._root}data/{key}"
        if name not in self._places or self._places[name][1] != size:
            there = f"{self._places[name][1]:,}" if name in self._places else "no"
            raise _RefusedError(f"the tensor {key[:20]} declares {size:,} bytes, there are {there}")
        return self.read(name).untyped_storage()

    def read(self, name: str) -> Tensor:
        """The bytes of a record."""
        start, size = self._places[name]
        if not 0 <= start <= self._size - _LOCAL.size:
            raise _RefusedError(f"its record {name[:80]!r} is not in it")
        self._file.seek(start)
        mark, named, more = _LOCAL.unpack(self._file.read(_LOCAL.size))
        begin = start + _LOCAL.size + named + more
        if mark != b"PK\3\4" or begin + size > self._size:
            raise _RefusedError(f"its record {name[:80]!r} is not in it")
        self._file.seek(begin)
        data = torch.empty(size, dtype=torch.uint8)
        if self._file.readinto(data.numpy()) != size:  # type: ignore[attr-defined]
            raise _RefusedError(f"its record {name[:80]!r} is cut short")
        return data


class _Machine:
    """Carries out the steps of a pickle that make data; any other step is refused."""

    def __init__(self, archive: _Archive, device: torch.device) -> None:
        self._archive, self._device = archive, device
        self._stack: list[Any] = []
        self._marks: list[int] = []
        self._memo: dict[int, Any] = {}
        self._storages: dict[str, tuple[torch.UntypedStorage, int]] = {}
        self._widened = 0
        self.steps = 0

    def run(self, description: bytes) -> Any:
        """What the description makes."""
        for step, value, _ in pickletools.genops(description):
            self.steps += 1
            if self.steps > _STEPS:
                raise _RefusedError(f"its description has more than {_STEPS:,} steps")
            if step.name == "STOP":
                (made,) = self._stack
                return made
            act = _ACTS.get(step.name)
            if act is None:
                raise _RefusedError(f"its description has the step {step.name}, which no data needs")
            act(self, value)
        raise _RefusedError("its description has no end")

    def push(self, value: Any) -> None:
        self._stack.append(value)

    def pop(self) -> Any:
        if self._marks and len(self._stack) <= self._marks[-1]:
            raise _RefusedError("its description is damaged: a mark is in the way")
        return self._stack.pop()

    def mark(self, _value: Any) -> None:
        self._marks.append(len(self._stack))

    def since_mark(self) -> list[Any]:
        place = self._marks.pop()
        values, self._stack[place:] = self._stack[place:], []
        return values

    def put(self, place: int) -> None:
        value = self.pop()
        self.push(value)
        self._memo[place] = value

    def take(self, count: int) -> list[Any]:
        return [self.pop() for _ in range(count)][::-1]

    def append(self, values: list[Any]) -> None:
        into = self.pop()
        if type(into) is not list:
            raise _RefusedError("its description is damaged: entries of no list")
        into.extend(values)
        self.push(into)

    def set_items(self, values: list[Any]) -> None:
        into = self.pop()
        if type(into) not in (dict, OrderedDict) or len(values) % 2:
            raise _RefusedError("its description is damaged: entries of no mapping")
        into.update(zip(values[::2], values[1::2], strict=True))
        self.push(into)

    def name(self, name: str) -> None:
        module, _, own = name.partition(" ")
        if module == "torch" and own in _DTYPES:
            self.push(_DTYPES[own])
        elif module == "torch" and own.endswith("Storage") and own.removesuffix("Storage") in _STORAGES:
            self.push(_Storage(torch.UntypedStorage(), _STORAGES[own.removesuffix("Storage")]))
        elif name == "torch.storage UntypedStorage":
            self.push(_Storage(torch.UntypedStorage(), None))
        elif name in _MAKERS:
            self.push(_MAKERS[name])
        else:
            shown = ".".join(name.split())[:80].encode("unicode_escape").decode()
            raise MoreThanDataError(f"more than tensors and plain data: {shown}")

    def call(self, _value: Any) -> None:
        maker, given = self.take(2)
        if not _is_maker(maker) or type(given) is not tuple:
            raise _RefusedError("its description is damaged: a call of no function")
        self.push(maker(self, *given))

    def build(self, _value: Any) -> None:
        into, state = self.take(2)
        if type(into) is not OrderedDict or type(state) is not dict or set(state) != {"_metadata"}:
            raise MoreThanDataError("more than tensors and plain data: an object with a state")
        into._metadata = state["_metadata"]  # type: ignore[attr-defined]  # the versions of modules
        self.push(into)

    def storage(self, _value: Any) -> None:
        mark, kind, key, _place, count = self.pop()
        if mark != "storage" or type(kind) is not _Storage or type(key) is not str or not _is_count(count):
            raise _RefusedError("its description is damaged: a storage without its numbers")
        size = count * (1 if kind.dtype is None else kind.dtype.itemsize)
        if key not in self._storages:
            own = self._archive.storage(key, size)
            if self._device.type != "cpu":
                own = torch.empty(0, dtype=torch.uint8).set_(own).to(self._device).untyped_storage()
            self._storages[key] = own, size
        if self._storages[key][1] != size:
            raise _RefusedError(f"the tensor {key[:20]} declares two sizes")
        self.push(_Storage(self._storages[key][0], kind.dtype))

    def tensor(
        self,
        storage: _Storage,
        offset: int,
        shape: tuple[int, ...],
        stride: tuple[int, ...],
        needs_grad: bool,
        _hooks: Any,
        dtype: torch.dtype | None = None,
    ) -> Tensor:
        if type(storage) is not _Storage or not isinstance(dtype := dtype or storage.dtype, torch.dtype):
            raise _RefusedError("its description is damaged: a tensor of no storage")
        numbers = storage.data.nbytes() // dtype.itemsize
        if not (
            type(shape) in (tuple, torch.Size)
            and type(stride) is tuple
            and len(shape) == len(stride) <= 64
            and all(map(_is_count, (offset, *shape, *stride)))
        ):
            raise _RefusedError("its description is damaged: a tensor without a shape")
        count = math.prod(shape)
        last = offset + sum((size - 1) * step for size, step in zip(shape, stride, strict=True))
        if count and last >= numbers:
            raise _RefusedError(f"a tensor of shape {list(shape)} has {numbers:,} numbers")
        if count > numbers:
            self._widened += count
            if self._widened > _WIDENED:
                raise _RefusedError(
                    f"a tensor of shape {list(shape)} has {numbers:,} numbers, which it repeats"
                )
        if not count and max(shape, default=0) > _WIDENED:
            raise _RefusedError(f"a tensor of shape {list(shape)} has no numbers")
        made = torch.empty(0, dtype=dtype, device=storage.data.device)
        made.set_(storage.data, offset if count else 0, shape, stride)
        return made.requires_grad_(needs_grad is True)


def _is_count(value: object) -> bool:
    return type(value) is int and 0 <= value < 1 << 62


def _bytes(_machine: _Machine, text: str = "", encoding: str = "latin1") -> bytes:
    if type(text) is not str or encoding != "latin1":
        raise _RefusedError("its description is damaged: bytes in no encoding")
    return text.encode("latin1")


def _complex(_machine: _Machine, real: float, imaginary: float) -> complex:
    if type(real) is not float or type(imaginary) is not float:
        raise _RefusedError("its description is damaged: a complex number of no numbers")
    return complex(real, imaginary)


def _shape(_machine: _Machine, shape: tuple[int, ...]) -> torch.Size:
    return torch.Size(shape)


def _place(_machine: _Machine, kind: str, index: int | None = None) -> torch.device:
    return torch.device(kind) if index is None else torch.device(kind, index)


def _mapping(_machine: _Machine) -> OrderedDict[Any, Any]:
    return OrderedDict()


def _tensor_2(machine: _Machine, *given: Any) -> Tensor:
    if len(given) != 6:
        raise _RefusedError("its description has a tensor of a kind that is not known here")
    return machine.tensor(*given)


def _tensor_3(machine: _Machine, *given: Any) -> Tensor:
    if len(given) != 7:
        raise _RefusedError("its description has a tensor of a kind that is not known here")
    return machine.tensor(*given)


def _parameter(_machine: _Machine, data: Tensor, needs_grad: bool, _hooks: Any) -> nn.Parameter:
    return nn.Parameter(data.detach(), requires_grad=needs_grad is True)


_MAKERS: dict[str, Callable[..., Any]] = {
    "_codecs encode": _bytes,
    "__builtin__ bytes": _bytes,
    "__builtin__ complex": _complex,
    "collections OrderedDict": _mapping,
    "torch Size": _shape,
    "torch device": _place,
    "torch._utils _rebuild_tensor_v2": _tensor_2,
    "torch._utils _rebuild_tensor_v3": _tensor_3,
    "torch._utils _rebuild_parameter": _parameter,
}


def _is_maker(value: object) -> bool:
    return any(value is own for own in _MAKERS.values())


_ACTS: dict[str, Callable[[_Machine, Any], None]] = {
    "PROTO": lambda _own, _value: None,
    "MARK": _Machine.mark,
    "NONE": lambda own, _value: own.push(None),
    "NEWTRUE": lambda own, _value: own.push(True),
    "NEWFALSE": lambda own, _value: own.push(False),
    "EMPTY_DICT": lambda own, _value: own.push({}),
    "EMPTY_LIST": lambda own, _value: own.push([]),
    "EMPTY_TUPLE": lambda own, _value: own.push(()),
    **dict.fromkeys(("BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT", "BINUNICODE"), _Machine.push),
    **dict.fromkeys(("BINPUT", "LONG_BINPUT"), _Machine.put),
    **dict.fromkeys(("BINGET", "LONG_BINGET"), lambda own, value: own.push(own._memo[value])),
    "TUPLE": lambda own, _value: own.push(tuple(own.since_mark())),
    "TUPLE1": lambda own, _value: own.push(tuple(own.take(1))),
    "TUPLE2": lambda own, _value: own.push(tuple(own.take(2))),
    "TUPLE3": lambda own, _value: own.push(tuple(own.take(3))),
    "APPEND": lambda own, _value: own.append(own.take(1)),
    "APPENDS": lambda own, _value: own.append(own.since_mark()),
    "SETITEM": lambda own, _value: own.set_items(own.take(2)),
    "SETITEMS": lambda own, _value: own.set_items(own.since_mark()),
    "GLOBAL": _Machine.name,
    "REDUCE": _Machine.call,
    "BUILD": _Machine.build,
    "BINPERSID": _Machine.storage,
}


def _check_tree(value: Any, *, most: int) -> None:
    """Refuses what holds itself, or the same so often that looking at all of it takes for ever.

    Args:
        value: what was read.

    Keyword Args:
        most: how many entries it may have, on all levels.

    Raises:
        ValueError: it does, or it holds what is no data by itself.
    """
    waiting, seen = [(value, 0)], 0
    while waiting:
        own, depth = waiting.pop()
        seen += 1
        if seen > most or depth > _DEPTH:
            raise _RefusedError("its entries are nested too deeply, or too many")
        if isinstance(own, dict):
            waiting += [(each, depth + 1) for pair in own.items() for each in pair]
        elif type(own) in (list, tuple):
            waiting += [(each, depth + 1) for each in own]
        elif type(own) is _Storage or _is_maker(own):
            raise _RefusedError("its description is damaged: a name that nothing was made of")
