"""The packed storage holds what TorchRL's storage holds."""

from __future__ import annotations

import os
import pickle
from collections.abc import Callable
from copy import deepcopy
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import NonTensorData, TensorDict, TensorDictBase
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from torchrl_her.replay_buffers import PackedStorage
from torchrl_her.replay_buffers.runs.storage import Move, layout, unpack, write_slices

from ....forks import result_of
from ...her_data import same

TYPES = [torch.bool, torch.uint8, torch.int16, torch.float32, torch.float64, torch.int64, torch.bfloat16]


def make_rows(n: int, seed: int = 0) -> TensorDict:
    """Rows [n] with entries of many types and shapes."""
    generator = torch.Generator().manual_seed(seed)

    def entry(i: int, dtype: torch.dtype, *shape: int) -> torch.Tensor:
        return (torch.rand(n, *shape, generator=generator) * 100 * (i + 1)).to(dtype)

    entries = {
        str(dtype)[6:]: entry(i, dtype, *((), (1,), (3,), (2, 5))[i % 4]) for i, dtype in enumerate(TYPES)
    }
    return TensorDict(
        {**entries, "next": {"x": entry(0, torch.float32, 9), "deep": {"y": entry(1, torch.bool, 1)}}}, [n]
    )


def filled(kind: type, rows: TensorDict, capacity: int = 20) -> LazyTensorStorage:
    storage = kind(capacity)
    storage.set(slice(0, 5), rows[:5])
    storage.set(torch.arange(5, len(rows)), rows[5:])
    return storage


INDICES = [torch.tensor([3, 3, 0, 11]), torch.tensor([-1, 2]), slice(2, 9, 2), 4, torch.arange(12) % 3 == 0]


@pytest.mark.parametrize("index", INDICES, ids=["rows", "negative", "slice", "one", "mask"])
def test_it_gives_what_torchrl_s_storage_gives(index: object) -> None:
    rows = make_rows(12)
    packed, theirs = filled(PackedStorage, rows), filled(LazyTensorStorage, rows)
    assert packed.packed is not None
    assert len(packed) == len(theirs) == 12
    assert same(packed.get(index), theirs.get(index))
    assert packed.get(index).batch_size == theirs.get(index).batch_size


def test_what_was_drawn_does_not_change_with_the_storage() -> None:
    storage = filled(PackedStorage, make_rows(12))
    drawn = storage.get(torch.tensor([0, 1]))
    before = drawn.clone()
    storage.set(slice(0, 2), make_rows(2, seed=1))
    assert same(drawn, before)
    drawn["next", "x"].zero_()
    assert not same(storage.get(torch.tensor([0, 1])), drawn)


def test_entries_lie_side_by_side_and_aligned() -> None:
    rows = make_rows(1)
    fields = layout(rows)
    assert {field.key for field in fields} == set(rows.keys(True, True))
    assert all(one.end == other.begin for one, other in pairwise(fields))
    assert all(field.begin % field.dtype.itemsize == 0 for field in fields)
    packed = torch.zeros(4, -(-fields[-1].end // 8), dtype=torch.int64)
    views = unpack(packed, fields)
    views["next", "x"][2] = 5.0
    assert packed[2].any()
    assert not packed[[0, 1, 3]].any()


def test_the_order_in_which_entries_come_does_not_matter() -> None:
    rows = make_rows(1)
    backwards = TensorDict(dict(reversed(list(rows.items()))), [1])
    assert list(backwards.keys()) == list(rows.keys())[::-1]
    assert layout(backwards) == layout(rows)


@pytest.mark.parametrize("kind", [PackedStorage, LazyTensorStorage])
def test_states_and_files_are_torchrl_s(kind: type, tmp_path: Path) -> None:
    """From either storage into a packed one."""
    rows = make_rows(12)
    source = filled(kind, rows)
    for other in (PackedStorage(20), filled(PackedStorage, make_rows(12, seed=1))):
        other.load_state_dict(source.state_dict())
        assert same(other.get(torch.arange(12)), rows)
        assert same(other.get(slice(0, 12)), rows)
        other.set(slice(0, 1), make_rows(1, seed=2))
        assert same(other.get(torch.tensor([0])), make_rows(1, seed=2))
    source.dumps(tmp_path / "storage")
    other = filled(PackedStorage, make_rows(12, seed=1))
    other.loads(tmp_path / "storage")
    assert same(other.get(torch.arange(12)), rows)


@pytest.mark.parametrize("copy", [deepcopy, lambda storage: pickle.loads(pickle.dumps(storage))])
def test_copies_keep_what_is_written_to_them(copy: Callable[[PackedStorage], PackedStorage]) -> None:
    rows = make_rows(12)
    source = filled(PackedStorage, rows)
    other = copy(source)
    assert same(other.get(torch.arange(12)), rows)
    other.set(slice(0, 2), make_rows(2, seed=1))
    assert same(other.get(torch.arange(2)), make_rows(2, seed=1))
    assert same(source.get(torch.arange(12)), rows)


def test_what_cannot_be_packed_is_kept_as_torchrl_does() -> None:
    storage = PackedStorage(4)
    storage.set(slice(0, 2), torch.arange(2.0))
    assert storage.packed is None
    assert storage.get(torch.tensor([1])).tolist() == [1.0]
    storage = PackedStorage(4)
    rows = TensorDict({"x": torch.arange(2.0), "name": NonTensorData("a", batch_size=[2])}, [2])
    storage.set(slice(0, 2), rows)
    assert storage.packed is None
    assert storage.get(torch.tensor([1]))["x"].tolist() == [1.0]


def test_a_buffer_with_it_is_emptied_and_filled_again() -> None:
    buffer = TensorDictReplayBuffer(storage=PackedStorage(10), batch_size=4)
    for seed in range(3):
        buffer.extend(make_rows(7, seed=seed))
    assert len(buffer) == 10
    buffer.empty()
    assert len(buffer) == 0
    buffer.extend(make_rows(3, seed=5).exclude("index"))
    assert same(buffer[:].exclude("index"), make_rows(3, seed=5))
    assert len(buffer.sample()) == 4


def with_late(rows: TensorDict) -> TensorDict:
    """The same rows with one more entry, as a policy or transform gives that was added later."""
    late = torch.arange(float(len(rows))).view(-1, 1)
    return rows.clone().update({"late": late, "next": {"deep": {"late": late.int()}}})


@pytest.mark.parametrize("index", [slice(5, 12), torch.arange(5, 12)], ids=["slice", "rows"])
def test_entries_that_come_later_are_kept(index: object) -> None:
    both = [kind(20) for kind in (PackedStorage, LazyTensorStorage)]
    for storage in both:
        storage.set(slice(0, 5), make_rows(5))
        storage.set(index, with_late(make_rows(7, seed=1)))
    packed, theirs = both
    assert packed.packed is not None
    for read in (torch.arange(5, 12), slice(5, 12)):
        assert same(packed.get(read), with_late(make_rows(7, seed=1)))
        assert same(packed.get(read), theirs.get(read))
    assert same(packed.get(torch.arange(5)).select(*make_rows(1).keys(True, True)), make_rows(5))
    assert {field.key for field in packed.fields} == set(with_late(make_rows(1)).keys(True, True))


def test_entries_that_come_later_and_cannot_be_packed_are_kept() -> None:
    storage = filled(PackedStorage, make_rows(12))
    rows = make_rows(2, seed=1).set("name", NonTensorData("a", batch_size=[2]))
    storage.set(slice(0, 2), rows)
    assert storage.packed is None
    assert storage.get(torch.tensor([0]))["name"] == "a"
    assert same(storage.get(torch.arange(2, 12)).exclude("name"), make_rows(12)[2:])


def test_entries_that_come_later_are_written_slice_by_slice() -> None:
    storage = filled(PackedStorage, make_rows(12))
    moves = [Move(slice(0, 2), slice(3, 5)), Move(slice(2, 4), slice(8, 10))]
    write_slices(storage, with_late(make_rows(4, seed=1)), moves)
    assert same(storage.get(torch.tensor([3, 4, 8, 9])), with_late(make_rows(4, seed=1)))


def test_rows_that_were_not_written_cannot_be_read() -> None:
    storage = filled(PackedStorage, make_rows(12))
    assert same(storage.get(torch.tensor([11])), make_rows(12)[11:])
    assert len(storage.get(torch.tensor([], dtype=torch.int64))) == 0
    for wrong in ([12], [0, 19], [20]):
        with pytest.raises(IndexError):
            storage.get(torch.tensor(wrong))
    full = filled(PackedStorage, make_rows(12), capacity=12)
    with pytest.raises(IndexError):
        full.get(torch.tensor([12]))


@pytest.mark.parametrize(
    "rows",
    [
        TensorDict({"x": torch.ones(2, 1), "a": TensorDict({"y": torch.ones(2, 3, 1)}, [2, 3])}, [2]),
        TensorDict({"x": torch.ones(2, 1), "a": TensorDict(batch_size=[2])}, [2]),
        TensorDict({"x": torch.ones(2, 3, 1)}, [2, 3]),
    ],
    ids=["batch size of its own", "empty", "two dimensions"],
)
def test_nested_tensordicts_come_back_as_they_were(rows: TensorDict) -> None:
    packed, theirs = (kind(4) for kind in (PackedStorage, LazyTensorStorage))
    for storage in (packed, theirs):
        storage.set(slice(0, 2), rows)
    assert packed.packed is None
    own, other = (storage.get(torch.tensor([1, 0])) for storage in (packed, theirs))
    assert same(own, other)
    assert own.batch_size == other.batch_size
    assert set(own.keys()) == set(other.keys())
    for key in own.keys():
        assert not isinstance(own[key], TensorDictBase) or own[key].batch_size == other[key].batch_size


def test_the_capacity_is_allocated_once(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[tuple[int, ...]] = []

    def noting(make: Callable[..., Any]) -> Callable[..., Any]:
        def make_and_note(*args: object, **options: object) -> Any:
            out = make(*args, **options)
            made.append(tuple(out.shape[:1]))
            return out

        return make_and_note

    for module, name in ((torch, "empty_like"), (torch, "zeros"), (np, "zeros")):
        monkeypatch.setattr(module, name, noting(getattr(module, name)))
    PackedStorage(1_000).set(slice(0, 2), make_rows(2))
    assert made.count((1_000,)) == 1


def used() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGESIZE")


def fill_a_little() -> tuple[int, int]:
    storage, before = PackedStorage(4_000_000), used()
    storage.set(slice(0, 1_000), TensorDict({"x": torch.ones(1_000, 12)}, [1_000]))
    return storage.packed.nbytes, used() - before


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="asks Linux for the memory in use")
def test_memory_is_taken_when_rows_come() -> None:
    # in a process of its own: one that has freed as much before may get that memory again, in use
    reserved, taken = result_of(fill_a_little)
    assert reserved > 100e6
    assert taken < 50e6
