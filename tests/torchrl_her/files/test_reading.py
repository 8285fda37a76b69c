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
from zipfile import ZIP_DEFLATED, ZIP_STORED

import pytest
import torch

from torchrl_her.files.reading import MoreThanDataError, load_tensors, read_tensors


def saved(value: Any) -> bytes:
    file = io.BytesIO()
    torch.save(value, file)
    return file.getvalue()


def packed(
    description: bytes, records: dict[str, bytes] | None = None, *, kind: int = ZIP_STORED, order: str = ""
) -> bytes:
    """An archive of any description."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", kind) as archive:
        archive.writestr("archive/data.pkl", description)
        for name, data in (records or {}).items():
            archive.writestr(f"archive/data/{name}", data)
        if order:
            archive.writestr("archive/byteorder", order)
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


EVERYTHING = {
    "numbers": [1, -5, 300, 70_000, 10**30, 0.5, float("inf"), 1j, True, None],
    "text": ["", "ä", b"\xff\0"],
    "tuples": ((), (1,), (1, 2), (1, 2, 3), (1, 2, 3, 4)),
    "torch": [torch.float32, torch.Size([2, 3]), torch.device("cpu"), torch.device("cuda", 1)],
    "tensors": [
        torch.arange(6.0).view(2, 3).t(),
        torch.tensor(3),
        torch.zeros(0, 5),
        torch.tensor([True, False]),
        torch.ones(3, dtype=torch.uint16),
        torch.ones(3, dtype=torch.bfloat16),
        torch.ones(2, 2, dtype=torch.complex64),
        torch.ones(1).expand(5),
        torch.nn.Parameter(torch.ones(2)),
    ],
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
    assert same(load_tensors(io.BytesIO(b"in front" + body)), expected)
    assert same(expected, EVERYTHING)
    assert load_tensors(io.BytesIO(body))["module"]._metadata == expected["module"]._metadata
    assert load_tensors(io.BytesIO(saved(b""))) == b""  # which torch refuses


def test_views_of_one_storage_stay_views_of_one() -> None:
    whole = torch.arange(4.0)
    first, second = load_tensors(io.BytesIO(saved([whole, whole[2:]])))
    first[3] = 9.0
    assert second.tolist() == [2.0, 9.0]


@pytest.mark.parametrize(
    ("body", "said"),
    [
        (b"", "damaged, or no archive of tensors"),
        (b"not torch's", "damaged, or no archive of tensors"),
        (packed(pickle.dumps(1, 2), kind=ZIP_DEFLATED), "record 'archive/data.pkl' is compressed"),
        (packed(pickle.dumps(1, 2), order="big"), "numbers are not in the order of bytes of this machine"),
        (packed(described(shape=(1 << 40,)), {"0": b"\0" * 16}), "shape [1099511627776] has 4 numbers"),
        (packed(described(shape=(9, 1 << 40), stride=(0, 0)), {"0": b"\0" * 16}), "which it repeats"),
        (packed(described(shape=(0, 1 << 40), stride=(1, 1)), {"0": b"\0" * 16}), "has no numbers"),
        (packed(described(offset=1), {"0": b"\0" * 16}), "shape [4] has 4 numbers"),
        (
            packed(described(numbers=1 << 40), {"0": b"\0" * 16}),
            "declares 4,398,046,511,104 bytes, there are",
        ),
        (packed(described(numbers=-1), {"0": b"\0" * 16}), "a storage without its numbers"),
        (packed(described(shape=(-4,)), {"0": b"\0" * 16}), "a tensor without a shape"),
        (packed(described(), {}), "declares 16 bytes, there are no"),
        (packed(pickle.dumps({1}, 2)), "more than tensors and plain data: __builtin__.set"),
        (packed(b"\x80\x02(lp0\ng0\na."), "has the step LIST"),
        (packed(b"\x80\x02]q\x00h\x00a."), "nested too deeply, or too many"),
        (
            packed(b"\x80\x02(]q\x00" + b"]q\x01(h\x00h\x00h\x00eq\x00" * 40 + b"t."),
            "too deeply, or too many",
        ),
        (packed(b"\x80\x02r\xff\xff\xff\x7f."), "its description is damaged (IndexError)"),
        (packed(b"\x80\x02X\xff\xff\xff\x7fa."), "its description is damaged (ValueError)"),
        (packed(b"\x80\x02c__builtin__\nbytearray\nM\xff\xff\x85R."), "plain data: __builtin__.bytearray"),
        (packed(b"\x80\x02ctorch\nSize\n."), "a name that nothing was made of"),
        (packed(b"\x80\x02."), "damaged"),
        (packed(b"\x80\x02N"), "its description is damaged (ValueError)"),
    ],
)
def test_what_is_no_data_is_refused_in_one_line(body: bytes, said: str, tmp_path: Path) -> None:
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
    body = bytearray(packed(pickle.dumps(1, 2), {"0": b"1234"}))
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
