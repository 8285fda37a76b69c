"""Checkpoints are whole or refused, run nothing, and bring a replay buffer back exactly."""

from __future__ import annotations

import hashlib
import io
import os
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import PrioritizedSampler, RandomSampler

from torchrl_her import (
    CheckpointError,
    GoalReward,
    HERWriter,
    buffer_state_dict,
    load_buffer_state_dict,
    load_checkpoint,
    save_checkpoint,
)

from .her_data import make_batch

STATE = {"epoch": 3, "name": "her", "rates": [0.5, None], "nested": {"weights": torch.arange(4.0)}}


# Files


def test_what_is_saved_is_loaded(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.pt"
    save_checkpoint(STATE, path)
    loaded = load_checkpoint(path)
    assert torch.equal(loaded["nested"].pop("weights"), torch.arange(4.0))
    assert loaded == {"epoch": 3, "name": "her", "rates": [0.5, None], "nested": {}}
    assert [file.name for file in tmp_path.iterdir()] == ["checkpoint.pt"]


def test_a_checkpoint_is_replaced(tmp_path: Path) -> None:
    path = str(tmp_path / "checkpoint.pt")
    save_checkpoint({"epoch": 1}, path)
    save_checkpoint({"epoch": 2}, path)
    assert load_checkpoint(path) == {"epoch": 2}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("checkpoint") / "whole.pt"
    save_checkpoint(STATE, path)
    return path


@settings(max_examples=100, deadline=None)
@given(st.floats(0.0, 1.0, exclude_max=True), st.integers(1, 255))
def test_any_damaged_byte_is_noticed(whole: Path, where: float, change: int) -> None:
    data = bytearray(whole.read_bytes())
    data[int(where * len(data))] ^= change
    damaged = whole.with_name("damaged.pt")
    damaged.write_bytes(data)
    with pytest.raises(CheckpointError, match=r"damaged\.pt is (damaged|not a checkpoint)"):
        load_checkpoint(damaged)


@settings(max_examples=50, deadline=None)
@given(st.floats(0.0, 1.0, exclude_max=True))
def test_a_file_that_was_cut_short_is_noticed(whole: Path, part: float) -> None:
    data = whole.read_bytes()
    short = whole.with_name("short.pt")
    short.write_bytes(data[: int(part * len(data))])
    with pytest.raises(CheckpointError, match=r"short\.pt is (damaged|not a checkpoint)"):
        load_checkpoint(short)


def test_damage_in_the_body_is_called_damage(whole: Path) -> None:
    damaged = whole.with_name("damaged.pt")
    damaged.write_bytes(whole.read_bytes()[:-1] + b"!")
    with pytest.raises(CheckpointError, match=r"damaged\.pt is damaged: its checksum does not match"):
        load_checkpoint(damaged)


def test_other_files_are_no_checkpoints(tmp_path: Path) -> None:
    path = tmp_path / "weights.pt"
    torch.save(STATE, path)
    with pytest.raises(CheckpointError, match=r"weights\.pt is not a checkpoint of torchrl-her"):
        load_checkpoint(path)


def test_a_file_that_is_not_there_is_an_os_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"missing\.pt"):
        load_checkpoint(tmp_path / "missing.pt")


class Harmful:
    """Leaves a file behind if anybody unpickles it."""

    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.trace,)


def test_objects_in_a_checkpoint_are_refused_and_not_run(tmp_path: Path) -> None:
    path, trace = tmp_path / "harmful.pt", tmp_path / "trace"
    save_checkpoint({"innocent": 1, "harmful": Harmful(trace)}, path)
    with pytest.raises(CheckpointError, match=r"harmful\.pt holds more than tensors and plain data"):
        load_checkpoint(path)
    assert not trace.exists()
    body = path.read_bytes()[-len(_saved({"innocent": 1, "harmful": Harmful(trace)})) :]
    torch.load(io.BytesIO(body), weights_only=False)
    assert trace.exists()  # it would have been harmful


def _saved(state: dict[str, Any]) -> bytes:
    file = io.BytesIO()
    torch.save(state, file)
    return file.getvalue()


@pytest.mark.parametrize("failing", ["replace", "fsync"])
def test_a_failing_write_leaves_the_old_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: str
) -> None:
    path = tmp_path / "checkpoint.pt"
    save_checkpoint({"epoch": 1}, path)

    def fail(*_: object) -> None:
        raise OSError("No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, failing, fail)
        with pytest.raises(OSError, match="No space left"):
            save_checkpoint({"epoch": 2}, path)
    assert load_checkpoint(path) == {"epoch": 1}
    save_checkpoint({"epoch": 3}, path)  # nor does what was left behind disturb the next one
    assert load_checkpoint(path) == {"epoch": 3}
    assert [file.name for file in tmp_path.iterdir()] == ["checkpoint.pt"]


def test_the_old_checkpoint_is_whole_until_the_new_one_is_on_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, seen = tmp_path / "checkpoint.pt", []
    save_checkpoint({"epoch": 1}, path)

    def look(part: Path, whole: Path) -> None:
        seen.append((load_checkpoint(part), load_checkpoint(whole)))

    monkeypatch.setattr(os, "replace", look)
    save_checkpoint({"epoch": 2}, path)
    assert seen == [({"epoch": 2}, {"epoch": 1})]


def test_the_format_is_a_mark_a_checksum_and_torchs_file(whole: Path) -> None:
    mark, data = b"torchrl-her checkpoint 1\n", whole.read_bytes()
    assert data.startswith(mark)
    body = data[len(mark) + 32 :]
    assert data[len(mark) : len(mark) + 32] == hashlib.sha256(body).digest()
    assert torch.load(io.BytesIO(body), weights_only=True)["epoch"] == 3


# Replay buffers


def make_buffer(sampler: str, capacity: int = 64) -> TensorDictReplayBuffer:
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(capacity),
        writer=HERWriter(GoalReward(0.5), k=2),
        sampler=RandomSampler() if sampler == "uniform" else PrioritizedSampler(capacity, 0.6, 0.4),
        batch_size=16,
        priority_key="td_error",
    )
    buffer.set_rng(torch.Generator().manual_seed(1))
    return buffer


def train(buffer: TensorDictReplayBuffer) -> TensorDict:
    """What a gradient step does to a buffer."""
    rows = buffer.sample()
    rows["td_error"] = rows["observation"][:, 0].abs() % 7.0 + 0.1
    buffer.update_tensordict_priority(rows)
    return rows


def same(one: TensorDict, other: TensorDict) -> bool:
    keys = set(one.keys(True, True))
    return keys == set(other.keys(True, True)) and all(torch.equal(one[key], other[key]) for key in keys)


def resumed(buffer: TensorDictReplayBuffer, sampler: str, folder: Path) -> TensorDictReplayBuffer:
    """A new buffer with the state of another one, which went through a file."""
    save_checkpoint(buffer_state_dict(buffer), folder / "buffer.pt")
    other = make_buffer(sampler, buffer.storage.max_size)
    load_buffer_state_dict(other, load_checkpoint(folder / "buffer.pt"))
    rng = torch.Generator()
    rng.set_state(buffer.writer._rng.get_state())
    other.set_rng(rng)
    return other


SAMPLERS = pytest.mark.parametrize("sampler", ["uniform", "prioritised"])


@SAMPLERS
@pytest.mark.parametrize(
    ("capacity", "batches"),
    [
        pytest.param(200, 1, id="part of it is filled"),
        pytest.param(64, 3, id="full, and written over from the start"),
        pytest.param(75, 1, id="just full"),
    ],
)
def test_a_resumed_buffer_goes_on_as_the_unbroken_one(
    sampler: str, capacity: int, batches: int, tmp_path: Path
) -> None:
    buffer = make_buffer(sampler, capacity)
    for _ in range(batches):
        buffer.extend(make_batch([[5, 5], [10], [3, 2]], steps=10))
        train(buffer)
    other = resumed(buffer, sampler, tmp_path)
    assert len(other) == len(buffer)
    assert same(other[:], buffer[:])
    for _ in range(3):
        assert same(train(other), train(buffer))
    more = make_batch([[4, 6], [7, 3]])
    assert torch.equal(other.extend(more.clone()), buffer.extend(more.clone()))
    assert other.writer.counts == buffer.writer.counts
    for _ in range(3):
        assert same(train(other), train(buffer))


@SAMPLERS
def test_episodes_held_back_go_on(sampler: str, tmp_path: Path) -> None:
    buffer = make_buffer(sampler)
    buffer.extend(make_batch([[3, 9], [2, 9]], steps=6))
    assert buffer.writer.held_back == 3 + 4
    train(buffer)  # new rows will get the greatest priority so far
    other = resumed(buffer, sampler, tmp_path)
    assert other.writer.held_back == 7
    rest = make_batch([[3, 9], [2, 9]], first=[(1, 3), (1, 4)], steps=6)
    assert torch.equal(other.extend(rest.clone()), buffer.extend(rest.clone()))
    assert other.writer.counts == buffer.writer.counts
    assert other.writer.counts.real == 3 + 2 + 9 + 9
    assert same(other[:], buffer[:])
    assert same(train(other), train(buffer))


@SAMPLERS
@pytest.mark.parametrize("emptied", [False, True])
def test_an_empty_buffer(sampler: str, emptied: bool, tmp_path: Path) -> None:
    buffer = make_buffer(sampler)
    if emptied:
        buffer.extend(make_batch([[5]]))
        train(buffer)
        buffer.empty()
    other = resumed(buffer, sampler, tmp_path)
    assert len(other) == 0
    for own in (buffer, other):
        own.extend(make_batch([[6, 4], [10]]))
    assert same(train(other), train(buffer))


@SAMPLERS
def test_a_state_is_small_and_apart_from_the_buffer(sampler: str, tmp_path: Path) -> None:
    buffer = make_buffer(sampler, capacity=100_000)
    buffer.extend(make_batch([[5]]))
    state = buffer_state_dict(buffer)
    before = state["rows"]["observation"].clone()
    buffer.storage[:]["observation"].fill_(9.0)
    assert torch.equal(state["rows"]["observation"], before)
    save_checkpoint(state, tmp_path / "buffer.pt")
    assert (tmp_path / "buffer.pt").stat().st_size < 30_000  # rows of 15, not of 100,000
