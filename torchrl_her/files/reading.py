"""Reads files that ``torch.save`` wrote, if they hold tensors and plain data and nothing else.

``torch.load(weights_only=True)`` executes nothing, but a small file can make it take any amount of memory
(torch 2.14: it unpacks compressed records, makes a ``bytearray`` of a declared length, and formats or hashes
values that share their parts over and over). The file is therefore checked before it is loaded.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Iterator
from pathlib import Path
from pickletools import genops, markobject
from typing import Any, BinaryIO
from zipfile import ZIP_STORED, ZipFile

import torch
from torch import Tensor, nn

_STEPS = 1 << 22  # largest number of opcodes of a pickle: checking them takes a few hundred megabytes
_DEPTH = 100
_REPEATED = 1 << 24  # number of elements by which tensors, as expanded views, may exceed their storages
# Last bytes of a zip archive by torch.save: size and offset of its list of files, and where the archive's
# last record begins. If these contradict each other, zipfile and torch may read different lists.
_END = struct.Struct("<4s36xQQ4s4xQ4x4s16xH")
_MARKS = (b"PK\6\6", b"PK\6\7", b"PK\5\6")
# torch ignores case in the names of records; those of tensors must be digits, which have no case.
_RECORD = re.compile(r"[^/\0]+/(data\.pkl|data/[0-9]+|\.?\w+|\.data/\w+)", re.ASCII)
_NAMES = {
    "collections OrderedDict",
    "torch Size",
    "torch.storage UntypedStorage",
    "torch._utils _rebuild_tensor_v2",
    "torch._utils _rebuild_tensor_v3",
    "torch._utils _rebuild_parameter",
    *(f"torch {name}" for name in dir(torch) if name.endswith("Storage")),
    *(f"torch {name}" for name in dir(torch) if isinstance(getattr(torch, name), torch.dtype)),
}
_NAME, _STORAGE = -1, 6  # size that marks a name; size of ("storage", type, key, device, count)
_SIZES = {"GLOBAL": _NAME, "BINPERSID": _STORAGE}
_NEEDS = {"REDUCE": _NAME, "NEWOBJ": _NAME, "BINPERSID": _STORAGE}  # what an opcode's first operand must be
_PLAIN = (bool, int, float, str, type(None), torch.dtype, dict, list, tuple)


class MoreThanDataError(ValueError):
    """A file names something that is neither a tensor nor plain data."""


def read_tensors(path: str | Path) -> Any:
    """Returns the tensors and plain data that ``torch.save`` wrote; refuses all else.

    Args:
        path: the file.

    Raises:
        ValueError: the file is damaged, or holds more than tensors and plain data, which the message names.
        OSError: the file cannot be read.

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
    """Returns the data that ``torch.save`` wrote, read from the position of an open file to its end.

    Args:
        file: Open file that can be read at any position.

    Keyword Args:
        map_location: Device of the loaded tensors.

    Raises:
        MoreThanDataError: the file holds other objects, too; the message completes "the file holds ...".
        ValueError: the file is damaged; the message completes "the file cannot be read: ...".
    """
    begin = file.tell()
    try:
        _check_archive(file, begin)
        file.seek(begin)
        _check_description(torch._C.PyTorchFileReader(file).get_record("data.pkl"))
        file.seek(begin)
        loaded = torch.load(file, map_location="cpu", weights_only=True, mmap=False)
        _check_tree(loaded)
        if torch.device(map_location).type != "cpu":  # other devices allocate any size that a file declares
            file.seek(begin)
            loaded = torch.load(file, map_location=map_location, weights_only=True, mmap=False)
        return loaded
    except (MoreThanDataError, _RefusedError):
        raise
    except Exception as error:  # reading a damaged pickle may raise any error
        raise ValueError(f"it is damaged ({type(error).__name__})") from error


class _RefusedError(ValueError):
    """A file contradicts itself, or torch.save did not write it. The message says where."""


def _check_archive(file: BinaryIO, begin: int) -> None:
    """Refuses an archive with records that are compressed, unknown, or larger than the file."""
    end = file.seek(0, 2)
    place = max(0, end - begin - _END.size)
    file.seek(begin + place)
    first, size, start, second, follows, third, comment = _END.unpack(file.read().rjust(_END.size))
    if (first, second, third) != _MARKS or comment or not start + size == follows == place:
        raise _RefusedError("it is cut short, or torch.save did not write it")
    with ZipFile(file) as archive:
        records = archive.infolist()
    names = [record.orig_filename for record in records]
    for record, name in zip(records, names, strict=True):
        if not _RECORD.fullmatch(name) or name.partition("/")[0] != names[0].partition("/")[0]:
            raise _RefusedError(f"it has the record {name[:80]!r}, which torch.save never writes")
        if record.compress_type != ZIP_STORED:
            raise _RefusedError(f"its record {name[:80]!r} is compressed")
    if len({name.lower() for name in names}) < len(names):
        raise _RefusedError("two of its records have the same name")
    if sum(record.file_size for record in records) > end:
        raise _RefusedError(f"its records are larger than its {end:,} bytes")


def _check_description(description: bytes) -> None:
    """Refuses a pickle that calls anything but constructors of tensors, or whose tuples expand too far.

    A tuple that holds a second tuple twice, which holds a third one twice, and so on, takes few bytes. But
    hashing it takes as long as if all entries were written out. So does printing such lists in an error
    message, so the operands that torch would print are checked, too.

    Raises:
        MoreThanDataError: the pickle names more than tensors and plain data.
        ValueError: the pickle is damaged, or too large with all tuples written in full.
    """
    stack: list[int] = []  # sizes of values; the size of a tuple is the sum over its entries
    marks: list[int] = []
    memo: dict[Any, int] = {}
    steps = 0
    for step, value, _ in genops(description):
        name, before = step.name, step.stack_before
        if name == "GLOBAL" and value not in _NAMES:
            excerpt = ".".join(str(value).split())[:80].encode("unicode_escape").decode()
            raise MoreThanDataError(f"more than tensors and plain data: {excerpt}")
        if name == "PROTO" and value != 2:
            raise _RefusedError(f"it is written in protocol {value} of pickle, not in 2")
        place = marks.pop() - before.index(markobject) if markobject in before else len(stack) - len(before)
        parts, stack[place:] = stack[place:], []
        if name in _NEEDS and parts[0] != _NEEDS[name]:
            raise _RefusedError(f"its description is damaged: {name} has a wrong operand")
        if "PUT" in name:
            memo[value] = stack[-1]
        size = 1
        if "GET" in name:
            size = memo[value]
        elif "TUPLE" in name:
            size += sum(map(abs, parts))
        elif name in _SIZES:
            size = _SIZES[name]
        steps += abs(size)
        if steps > _STEPS:
            raise _RefusedError(f"its description has more than {_STEPS:,} steps")
        if name == "MARK":
            marks.append(len(stack))
        elif step.stack_after:
            stack.append(size)


def _check_tree(loaded: Any) -> None:
    """Refuses values that are not plain data, and views with far more elements than their storages."""
    repeated = 0
    for count, value in enumerate(_values(loaded)):
        if type(value) in (Tensor, nn.Parameter):
            stored = value.untyped_storage().nbytes() // value.itemsize
            repeated += max(0, math.prod(max(1, size) for size in value.shape) - stored)
        elif not isinstance(value, _PLAIN):
            raise MoreThanDataError(f"more than tensors and plain data: {type(value).__name__}")
        if count > _STEPS:
            raise _RefusedError(f"it has more than {_STEPS:,} entries")
        if repeated > _REPEATED:
            raise _RefusedError(f"a tensor of shape {list(value.shape)} is larger than its storage")


def _values(value: Any, depth: int = 0) -> Iterator[Any]:
    """Yields a value, and the values in it if it is a mapping, a list or a tuple."""
    if depth > _DEPTH:
        raise _RefusedError(f"its entries are nested more than {_DEPTH} levels deep")
    yield value
    if isinstance(value, dict):
        value = [part for pair in value.items() for part in pair]
    if isinstance(value, list | tuple):
        for part in value:
            yield from _values(part, depth + 1)
