"""Reading tensors: the same as torch's own reader, or one line."""

from __future__ import annotations

import io
import pickle
import re
import tracemalloc
import zipfile
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock
from zipfile import ZIP_DEFLATED, ZIP_STORED

import pytest
import torch

from torchrl_her.files import reading
from torchrl_her.files.reading import MoreThanDataError, load_tensors, read_tensors


def saved(value: Any) -> bytes:
    file = io.BytesIO()
    torch.save(value, file)
    return file.getvalue()


def packed(description: bytes, records: dict[str, bytes] | None = None, *, kind: int = ZIP_STORED) -> bytes:
    """An archive of any description, that ends as torch's do."""
    file = io.BytesIO()
    # Zip64, whose end zipfile else writes for large archives alone.
    with mock.patch.object(zipfile, "ZIP_FILECOUNT_LIMIT", 0), zipfile.ZipFile(file, "w", kind) as archive:
        for name, data in {"data.pkl": description, "version": b"3\n", **(records or {})}.items():
            archive.writestr(f"archive/{name}", data)
    return file.getvalue()


def described(
    *, numbers: int = 4, offset: int = 0, shape: tuple[int, ...] = (4,), stride: tuple[int, ...] = (1,)
) -> bytes:
    """A tensor of float32 that declares what it likes."""

    class Storage:
        pass

    class Pickler(pickle.Pickler):
        def persistent_id(self, own: Any) -> Any:
            kind = torch.FloatStorage
            return ("storage", kind, "0", "cpu", numbers) if isinstance(own, Storage) else None

    class Tensor:
        def __reduce__(self) -> Any:
            given = (Storage(), offset, shape, stride, False, OrderedDict())
            return torch._utils._rebuild_tensor_v2, given

    file = io.BytesIO()
    Pickler(file, 2).dump(Tensor())
    return file.getvalue()


TWICE = [("next", "observation"), (torch.Size([3]), (1, 2)), torch.ones(2)]
EVERYTHING = {
    "numbers": [1, -5, 300, 70_000, 10**30, 0.5, float("inf"), True, None],
    "text": ["", "ä", "ä"],
    "tuples": ((), (1,), (1, 2), (1, 2, 3), (1, 2, 3, 4)),
    "torch": [torch.float32, torch.float32, torch.Size([2, 3])],
    "tensors": [
        torch.arange(6.0).view(2, 3).t(),
        torch.arange(6.0, dtype=torch.float64)[1::2],
        torch.tensor(3),
        torch.zeros(0, 5),
        torch.tensor([True, False]),
        torch.ones(3, dtype=torch.uint16),
        torch.ones(3, dtype=torch.bfloat16),
        torch.ones(2, 2, dtype=torch.complex64),
        torch.ones(1).expand(5),
    ],
    "twice": [TWICE, TWICE],
    "parameter": torch.nn.Parameter(torch.ones(2)),
    "ordered": OrderedDict(a=1, b=OrderedDict()),
    "module": torch.nn.BatchNorm1d(3).state_dict(),
}


def same(first: Any, second: Any) -> bool:
    if type(first) is not type(second):
        return False
    if isinstance(first, torch.Tensor):
        same_kind = first.dtype == second.dtype and first.stride() == second.stride()
        return same_kind and first.requires_grad == second.requires_grad and torch.equal(first, second)
    if isinstance(first, dict):
        return list(first) == list(second) and all(map(same, first.values(), second.values()))
    if isinstance(first, list | tuple):
        return len(first) == len(second) and all(map(same, first, second))
    return first == second


def test_it_reads_what_torch_reads() -> None:
    body = saved(EVERYTHING)
    expected = torch.load(io.BytesIO(body), weights_only=True)
    behind = io.BytesIO(b"in front" + body)
    behind.seek(len(b"in front"))
    assert same(load_tensors(behind), expected)
    assert same(expected, EVERYTHING)
    assert load_tensors(io.BytesIO(body))["module"]._metadata == expected["module"]._metadata


def test_views_of_one_storage_stay_views_of_one() -> None:
    whole = torch.arange(4.0)
    first, second = load_tensors(io.BytesIO(saved([whole, whole[2:]])))
    first[3] = 9.0
    assert second.tolist() == [2.0, 9.0]


TUPLES = b")q\x00" + b"".join(b"h%ch%c\x86q%c" % (i, i, i + 1) for i in range(60))
LISTS = b"]q\x00" + b"".join(b"]q%c(h%ch%ce" % (i + 1, i, i) for i in range(60))
NUMBERS = {"data/0": b"\0" * 16}


@pytest.mark.parametrize(
    ("body", "said"),
    [
        (b"", "cut short, or torch.save did not write it"),
        (b"not torch's", "cut short, or torch.save did not write it"),
        (packed(pickle.dumps(1, 2))[:-1], "cut short, or torch.save did not write it"),
        (2 * packed(pickle.dumps(1, 2)), "cut short, or torch.save did not write it"),
        (packed(pickle.dumps(1, 2), kind=ZIP_DEFLATED), "record 'archive/data.pkl' is compressed"),
        (packed(pickle.dumps(1, 2), {"DATA.PKL": b""}), "has the record 'archive/DATA.PKL', which"),
        (packed(pickle.dumps(1, 2), {"data/a": b""}), "has the record 'archive/data/a', which"),
        (packed(pickle.dumps(1, 2), {"VERSION": b"3\n"}), "two of its records have the same name"),
        (packed(described(shape=(1 << 40,)), NUMBERS), "(RuntimeError)"),
        (packed(described(shape=(9, 1 << 40), stride=(0, 0)), NUMBERS), "larger than its storage"),
        (packed(described(shape=(0, 1 << 40), stride=(1, 1)), NUMBERS), "larger than its storage"),
        (packed(described(offset=1), NUMBERS), "(RuntimeError)"),
        (packed(described(numbers=1 << 40), NUMBERS), "(RuntimeError)"),
        (packed(described(numbers=-1), NUMBERS), "(TypeError)"),
        (packed(described(shape=(-4,)), NUMBERS), "(RuntimeError)"),
        (packed(described(), {}), "(RuntimeError)"),
        (packed(pickle.dumps({1}, 2)), "more than tensors and plain data: __builtin__.set"),
        (packed(pickle.dumps(1, 4)), "written in protocol 4 of pickle, not in 2"),
        (packed(b"\x80\x02\x8f."), "more than tensors and plain data: set"),
        (packed(b"\x80\x02]q\x00h\x00a."), "nested more than 100 levels deep"),
        (packed(b"\x80\x02" + b"]" * 200 + b"a" * 199 + b"."), "nested more than 100 levels deep"),
        (packed(b"\x80\x02(" + LISTS + b"t."), "more than 10,000 entries"),
        (packed(b"\x80\x02" + TUPLES + b"."), "more than 10,000 steps"),
        (packed(b"\x80\x02" + b"N" * 10_000 + b"."), "more than 10,000 steps"),
        (packed(b"\x80\x02" + LISTS + b")R."), "REDUCE has a wrong operand"),
        (packed(b"\x80\x02" + LISTS + b")\x81."), "NEWOBJ has a wrong operand"),
        (packed(b"\x80\x02" + LISTS + b"Q."), "BINPERSID has a wrong operand"),
        (packed(b"\x80\x02X\xff\xff\xff\x7fa."), "(ValueError)"),
        (packed(b"\x80\x02c__builtin__\nbytearray\nM\xff\xff\x85R."), "plain data: __builtin__.bytearray"),
        (packed(b"\x80\x02ctorch\nSize\n."), "more than tensors and plain data: type"),
        (packed(b"\x80\x02."), "(IndexError)"),
        (packed(b"\x80\x02N"), "(ValueError)"),
    ],
)
def test_what_is_no_data_is_refused_in_one_line(
    body: bytes, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reading, "_STEPS", 10_000)
    path = tmp_path / "strange.pt"
    path.write_bytes(body)
    tracemalloc.start()
    with pytest.raises(ValueError, match=re.escape(f"{path} ")) as raised:
        read_tensors(path)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert said in str(raised.value)
    assert "\n" not in str(raised.value)
    assert most < 1 << 27


def test_more_records_than_bytes_are_refused() -> None:
    body = bytearray(packed(pickle.dumps(1, 2), {"data/0": b"1234"}))
    place = body.rindex(b"PK\1\2") + 20  # the two sizes of the last record
    body[place : place + 8] = (1 << 30).to_bytes(4, "little") * 2
    with pytest.raises(ValueError, match=r"records are larger than its \d+ bytes"):
        load_tensors(io.BytesIO(body))


@pytest.mark.parametrize("call", [eval, exec, print, torch.load, io.open, __import__])
def test_nothing_is_called(call: Callable[..., Any]) -> None:
    class Harmful:
        def __reduce__(self) -> Any:
            return call, ("1",)

    with pytest.raises(MoreThanDataError, match="more than tensors and plain data"):
        load_tensors(io.BytesIO(saved(Harmful())))
