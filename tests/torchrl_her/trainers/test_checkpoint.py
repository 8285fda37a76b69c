"""Checkpoints are whole or refused, run nothing, and bring a replay buffer back exactly."""

from __future__ import annotations

import errno
import hashlib
import io
import os
import re
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import MemoryMappedTensor, TensorDict
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import (
    ConsumingSampler,
    PrioritizedSampler,
    PrioritizedSliceSampler,
    RandomSampler,
    Sampler,
    SamplerEnsemble,
    SamplerWithoutReplacement,
    SliceSampler,
    SliceSamplerWithoutReplacement,
)

from torchrl_her import GoalReward, HERSampleUnit, HERWriter, load_checkpoint, save_checkpoint
from torchrl_her.trainers import (
    CheckpointError,
    buffer_state_dict,
    collector_state_dict,
    load_buffer_state_dict,
    load_collector_state_dict,
    load_newest_checkpoint,
)
from torchrl_her.trainers.checkpoint import load_sampler_state_dict, sampler_state_dict
from torchrl_her_envs import make_env

from ..her_data import make_batch, same

MARK = b"torchrl-her checkpoint 1\n"
STATE = {"epoch": 3, "name": "her", "rates": [0.5, None], "nested": {"weights": torch.arange(4.0)}}


# Files


def test_what_is_saved_is_loaded(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.pt"
    save_checkpoint(STATE, path)
    loaded = load_checkpoint(path)
    assert torch.equal(loaded["nested"].pop("weights"), torch.arange(4.0))
    assert loaded == {"epoch": 3, "name": "her", "rates": [0.5, None], "nested": {}}
    assert [file.name for file in tmp_path.iterdir()] == ["checkpoint.pt"]


@pytest.mark.parametrize("value", [np.float64(1.0), np.int64(1), Path("a"), {1, 2}, b"1"])
def test_what_could_not_be_loaded_is_not_saved(value: Any, tmp_path: Path) -> None:
    said = rf"the state\['own'\]\[1\] must be a tensor or plain data, got {type(value).__name__}"
    with pytest.raises(TypeError, match=said):
        save_checkpoint({"own": [1, value]}, tmp_path / "checkpoint.pt")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("state", "said"),
    [
        (torch.eye(2).to_sparse(), "Tensor (written as _rebuild_sparse_tensor)"),
        (nn.Parameter(torch.eye(2).to_sparse()), "Parameter (written as _rebuild_sparse_tensor)"),
        (torch.zeros(2, device="meta"), "Tensor (written as _rebuild_meta_tensor_no_storage)"),
        (MemoryMappedTensor.from_tensor(torch.ones(2)), "MemoryMappedTensor (written as from_handler)"),
        ({np.int64(1): 2}, "the key np.int64(1) of the state['own'] must be a tensor or plain data"),
    ],
)
def test_tensors_and_keys_that_could_not_be_loaded_leave_the_old_checkpoint(
    state: Any, said: str, tmp_path: Path
) -> None:
    save_checkpoint({"epoch": 1}, tmp_path / "checkpoint.pt")
    with pytest.raises(TypeError, match=re.escape(said)):
        save_checkpoint({"own": state}, tmp_path / "checkpoint.pt")
    assert load_checkpoint(tmp_path / "checkpoint.pt") == {"epoch": 1}


def test_parameters_and_rows_of_memory_maps_are_saved(tmp_path: Path) -> None:
    rows = MemoryMappedTensor.from_tensor(torch.arange(3.0))
    save_checkpoint([nn.Parameter(torch.ones(2)), rows.data, rows.clone()], tmp_path / "checkpoint.pt")  # type: ignore[arg-type]
    loaded = load_checkpoint(tmp_path / "checkpoint.pt")
    assert [own.tolist() for own in loaded] == [[1.0, 1.0], [0.0, 1.0, 2.0], [0.0, 1.0, 2.0]]


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


def test_anything_else_behind_a_right_checksum_is_refused(whole: Path) -> None:
    strange, body = whole.with_name("strange.pt"), b"not torch's"
    strange.write_bytes(MARK + hashlib.sha256(body).digest() + body)
    with pytest.raises(CheckpointError, match=r"strange\.pt (cannot be read: \S|holds more than tensors)"):
        load_checkpoint(strange)


def test_other_files_are_no_checkpoints(tmp_path: Path) -> None:
    path = tmp_path / "weights.pt"
    torch.save(STATE, path)
    with pytest.raises(CheckpointError, match=r"weights\.pt is not a checkpoint of torchrl-her"):
        load_checkpoint(path)


class Harmful:
    """Leaves a file behind if anybody unpickles it."""

    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.trace,)


def test_objects_in_a_checkpoint_are_refused_and_not_run(tmp_path: Path) -> None:
    path, trace = tmp_path / "harmful.pt", tmp_path / "trace"
    body = _saved({"innocent": 1, "harmful": Harmful(trace)})
    path.write_bytes(MARK + hashlib.sha256(body).digest() + body)
    with pytest.raises(CheckpointError, match=r"harmful\.pt holds more than tensors and plain data"):
        load_checkpoint(path)
    assert not trace.exists()
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
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(os, failing, fail)
        with pytest.raises(OSError, match=r"No space left on device: '.*checkpoint\.pt'"):
            save_checkpoint({"epoch": 2}, path)
    assert load_checkpoint(path) == {"epoch": 1}
    assert [file.name for file in tmp_path.iterdir()] == ["checkpoint.pt"]


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="there is no disk that is always full")
@pytest.mark.parametrize("numbers", [10, 10_000_000])
def test_a_full_disk_leaves_the_old_checkpoint(tmp_path: Path, numbers: int) -> None:
    path = tmp_path / "checkpoint.pt"
    save_checkpoint({"epoch": 1}, path)
    (tmp_path / "checkpoint.part.pt").symlink_to("/dev/full")
    with pytest.raises(OSError, match=r"No space left on device: '.*checkpoint\.pt'"):
        save_checkpoint({"epoch": 2, "weights": torch.zeros(numbers)}, path, keep=2)
    assert load_checkpoint(path) == {"epoch": 1}
    assert [file.name for file in tmp_path.iterdir()] == ["checkpoint.pt"]


def test_a_checkpoint_is_not_in_memory_while_it_is_written(tmp_path: Path) -> None:
    state = {"weights": torch.arange(30_000_000.0)}
    save_checkpoint({}, tmp_path / "checkpoint.pt")  # what is imported on the way
    tracemalloc.start()
    save_checkpoint(state, tmp_path / "checkpoint.pt")
    assert tracemalloc.get_traced_memory()[1] < 2_000_000  # bytes, of 120 million
    tracemalloc.stop()
    assert torch.equal(load_checkpoint(tmp_path / "checkpoint.pt")["weights"], state["weights"])


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


# The last ones


def saved(folder: Path, epochs: int, keep: int = 2) -> Path:
    """The path of checkpoints after some epochs."""
    path = folder / "checkpoint.pt"
    for epoch in range(1, epochs + 1):
        save_checkpoint({"epoch": epoch}, path, keep=keep)
    return path


def test_the_last_ones_are_kept(tmp_path: Path) -> None:
    saved(tmp_path, epochs=5, keep=3)
    found = {path.name: load_checkpoint(path)["epoch"] for path in tmp_path.iterdir()}
    assert found == {"checkpoint.pt": 5, "checkpoint.1.pt": 4, "checkpoint.2.pt": 3}


@pytest.mark.parametrize("data", [b"", b"torchrl-her checkpoint 1\nhalf a check", b"something else"])
def test_the_one_before_a_damaged_one_is_used(tmp_path: Path, data: bytes) -> None:
    path = saved(tmp_path, epochs=3)
    path.write_bytes(data)
    said = r"^\S+/checkpoint\.pt is [^;\n]+; checkpoint\.1\.pt, the one before, is used instead$"
    with pytest.warns(UserWarning, match=said):
        assert load_newest_checkpoint(path) == {"epoch": 2}


def test_the_one_before_is_the_newest_while_files_are_renamed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, replace = saved(tmp_path, epochs=2), os.replace
    seen = []

    def look(old: Path, new: Path) -> None:
        replace(old, new)
        seen.append(load_newest_checkpoint(path))

    monkeypatch.setattr(os, "replace", look)
    save_checkpoint({"epoch": 3}, path, keep=2)
    assert seen == [{"epoch": 2}, {"epoch": 3}]


def test_none_that_is_whole_is_an_error(tmp_path: Path) -> None:
    path = saved(tmp_path, epochs=2)
    for file in tmp_path.iterdir():
        file.write_bytes(file.read_bytes()[:-1])
    said = r"checkpoint\.pt is damaged: its checksum does not match; .*checkpoint\.1\.pt is damaged"
    with pytest.raises(CheckpointError, match=said):
        load_newest_checkpoint(path)


def test_none_at_all_is_an_os_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"checkpoint\.pt"):
        load_newest_checkpoint(tmp_path / "checkpoint.pt")


# Replay buffers


MAKE_SAMPLER: dict[str, Callable[[int], Sampler]] = {
    "uniform": lambda capacity: RandomSampler(),
    "prioritized": lambda capacity: PrioritizedSampler(capacity, 0.6, 0.4),
    "without replacement": lambda capacity: SamplerWithoutReplacement(),
    "in order": lambda capacity: SamplerWithoutReplacement(shuffle=False),
}


def make_buffer(sampler: str, capacity: int = 64) -> TensorDictReplayBuffer:
    writer = HERWriter(GoalReward(0.5), k=2)
    return buffer_of(MAKE_SAMPLER[sampler](capacity), LazyTensorStorage(capacity), writer=writer)


def buffer_of(sampler: Sampler, storage: LazyTensorStorage, **parts: Any) -> TensorDictReplayBuffer:
    buffer = TensorDictReplayBuffer(
        storage=storage, sampler=sampler, batch_size=16, priority_key="td_error", **parts
    )
    buffer.set_rng(torch.Generator().manual_seed(1))
    return buffer


def draw(buffer: TensorDictReplayBuffer) -> TensorDict:
    """What a gradient step does to a buffer."""
    rows = buffer.sample()
    rows["td_error"] = rows["observation"][:, 0].abs() % 7.0 + 0.1
    buffer.update_tensordict_priority(rows)
    return rows


def resumed(buffer: TensorDictReplayBuffer, sampler: str, folder: Path) -> TensorDictReplayBuffer:
    """A new buffer with the state of another one, which went through a file."""
    save_checkpoint(buffer_state_dict(buffer), folder / "buffer.pt")
    other = make_buffer(sampler, buffer.storage.max_size)
    load_buffer_state_dict(other, load_checkpoint(folder / "buffer.pt"))
    rng = torch.Generator()
    rng.set_state(buffer.writer._rng.get_state())
    other.set_rng(rng)
    return other


SAMPLERS = pytest.mark.parametrize("sampler", list(MAKE_SAMPLER))


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
        buffer.extend(make_batch([[5, 5], [10], [3, 7]], steps=10))
        draw(buffer)
    other = resumed(buffer, sampler, tmp_path)
    assert len(other) == len(buffer)
    assert same(other[:], buffer[:])
    for _ in range(3):
        assert same(draw(other), draw(buffer))
    more = make_batch([[4, 6], [7, 3]])
    assert torch.equal(other.extend(more.clone()), buffer.extend(more.clone()))
    assert other.writer.counts == buffer.writer.counts
    for _ in range(3):
        assert same(draw(other), draw(buffer))


@SAMPLERS
def test_episodes_held_back_go_on(sampler: str, tmp_path: Path) -> None:
    buffer = make_buffer(sampler)
    buffer.extend(make_batch([[3, 9], [2, 9]], steps=6))
    assert buffer.writer.held_back == 3 + 4
    draw(buffer)  # new rows will get the greatest priority so far
    other = resumed(buffer, sampler, tmp_path)
    assert other.writer.held_back == 7
    rest = make_batch([[3, 9], [2, 9]], first=[(1, 3), (1, 4)], steps=6)
    assert torch.equal(other.extend(rest.clone()), buffer.extend(rest.clone()))
    assert other.writer.counts == buffer.writer.counts
    assert other.writer.counts.real == 3 + 2 + 9 + 9
    assert same(other[:], buffer[:])
    assert same(draw(other), draw(buffer))


@SAMPLERS
@pytest.mark.parametrize("emptied", [False, True])
def test_an_empty_buffer(sampler: str, emptied: bool, tmp_path: Path) -> None:
    buffer = make_buffer(sampler)
    if emptied:
        buffer.extend(make_batch([[5]]))
        draw(buffer)
        buffer.empty()
    other = resumed(buffer, sampler, tmp_path)
    assert len(other) == 0
    for own in (buffer, other):
        own.extend(make_batch([[6, 4], [10]]))
    assert same(draw(other), draw(buffer))


@SAMPLERS
def test_a_state_is_small_and_apart_from_the_buffer(sampler: str, tmp_path: Path) -> None:
    buffer = make_buffer(sampler, capacity=100_000)
    buffer.extend(make_batch([[5]]))
    state = buffer_state_dict(buffer)
    before = state["rows"][0]["entries"]["observation"].clone()
    buffer.storage[:]["observation"].fill_(9.0)
    assert torch.equal(state["rows"][0]["entries"]["observation"], before)
    save_checkpoint(state, tmp_path / "buffer.pt")
    assert (tmp_path / "buffer.pt").stat().st_size < 30_000  # rows of 15, not of 100,000


def test_a_state_without_a_copy_is_as_small(tmp_path: Path) -> None:
    buffer = make_buffer("uniform", capacity=100_000)
    buffer.extend(make_batch([[5]]))
    state, copied = buffer_state_dict(buffer, copy=False), buffer_state_dict(buffer)
    save_checkpoint(state, tmp_path / "buffer.pt")
    assert (tmp_path / "buffer.pt").stat().st_size < 30_000
    rows, expected = (
        TensorDict(own["rows"][0]["entries"], [15])
        for own in (load_checkpoint(tmp_path / "buffer.pt"), copied)
    )
    assert same(rows, expected)
    buffer.storage[:]["observation"].fill_(9.0)
    assert (state["rows"][0]["entries"]["observation"] == 9.0).all()


@SAMPLERS
def test_rows_of_two_dimensions_go_on(sampler: str, tmp_path: Path) -> None:
    def make() -> TensorDictReplayBuffer:
        hindsight = HERSampleUnit(GoalReward(0.5))
        storage, parts = LazyTensorStorage(40, ndim=2), {"collate_fn": hindsight.relabel}
        return buffer_of(MAKE_SAMPLER[sampler](40), storage, sample_unit=hindsight, **parts)

    buffer, other = make(), make()
    buffer.extend(make_batch([[5, 9], [9, 5]], steps=7))
    save_checkpoint(buffer_state_dict(buffer), tmp_path / "buffer.pt")
    load_buffer_state_dict(other, load_checkpoint(tmp_path / "buffer.pt"))
    assert len(other) == len(buffer) == 14
    assert same(other.storage[:], buffer.storage[:])
    assert same(other.sample(), buffer.sample())
    more = make_batch([[4], [4]])
    for own in (buffer, other):
        own.extend(more)
    assert same(other.storage[:], buffer.storage[:])


@pytest.mark.parametrize(
    ("sampler", "capacity", "full", "message"),
    [
        ("uniform", 64, True, "the buffer must be empty, it holds 15 rows"),
        ("uniform", 65, False, "the state must have a capacity of 65 rows, got 64"),
        ("in order", 64, False, "the state must be of a SamplerWithoutReplacement, got a RandomSampler"),
        ("prioritized", 64, False, "the state must be of a PrioritizedSampler, got a RandomSampler"),
    ],
)
def test_buffers_of_another_make_are_refused(sampler: str, capacity: int, full: bool, message: str) -> None:
    buffer, other = make_buffer("uniform"), make_buffer(sampler, capacity)
    buffer.extend(make_batch([[5]]))
    if full:
        other.extend(make_batch([[5]]))
    with pytest.raises(ValueError, match=message):
        load_buffer_state_dict(other, buffer_state_dict(buffer))


# Samplers of sequences, and of rows that are used up


def slices(kind: type[Sampler], *args: Any) -> Callable[[], Sampler]:
    return lambda: kind(*args, slice_len=4, traj_key="episode", strict_length=False)


def by_ends(kind: type[Sampler], *args: Any) -> Callable[[], Sampler]:
    return lambda: kind(*args, slice_len=4, end_key=("next", "done"), strict_length=False)


def make_steps(lengths: list[int], first: int) -> TensorDict:
    """Rows of some episodes, one after the other."""
    episode = torch.arange(first, first + len(lengths)).repeat_interleave(torch.tensor(lengths))
    done = torch.zeros(sum(lengths), 1, dtype=torch.bool)
    done[torch.tensor(lengths).cumsum(0) - 1] = True
    return TensorDict(
        {
            "observation": torch.arange(len(episode)).unsqueeze(-1) + 1000.0 * first,
            "episode": episode,
            "next": {"done": done, "terminated": done.clone(), "truncated": torch.zeros_like(done)},
        },
        [len(episode)],
    )


@pytest.mark.filterwarnings("ignore:SliceSampler returned a short flat batch:UserWarning")
@pytest.mark.parametrize("emptied", [False, True])
@pytest.mark.parametrize("over", [False, True], ids=["filled in part", "written over"])
@pytest.mark.parametrize(
    "make_sampler",
    [
        pytest.param(slices(SliceSampler), id="slice"),
        pytest.param(by_ends(SliceSampler), id="slice, by ends"),
        pytest.param(slices(SliceSamplerWithoutReplacement), id="slice without replacement"),
        pytest.param(by_ends(SliceSamplerWithoutReplacement), id="slice without replacement, by ends"),
        pytest.param(slices(PrioritizedSliceSampler, 100, 0.6, 0.4), id="prioritized slice"),
        pytest.param(by_ends(PrioritizedSliceSampler, 100, 0.6, 0.4), id="prioritized slice, by ends"),
        pytest.param(
            lambda: SamplerWithoutReplacement(drop_last=True), id="whole batches without replacement"
        ),
        pytest.param(lambda: ConsumingSampler(max_sample_count=2), id="consuming"),
    ],
)
def test_the_next_batches_are_those_of_the_unbroken_run(
    make_sampler: Callable[[], Sampler], over: bool, emptied: bool, tmp_path: Path
) -> None:
    buffer, other = (buffer_of(make_sampler(), LazyTensorStorage(100)) for _ in range(2))
    for first in (0, 10, 20) if over else (0,):
        buffer.extend(make_steps([5, 9, 3, 12, 7, 6], first))
        for _ in range(2):
            draw(buffer)
    if emptied:
        buffer.empty()
        buffer.extend(make_steps([8, 11, 4], 40))
        draw(buffer)
    state = {"buffer": buffer_state_dict(buffer), "random": buffer.sampler._rng.get_state()}
    save_checkpoint(state, tmp_path / "buffer.pt")
    state = load_checkpoint(tmp_path / "buffer.pt")
    load_buffer_state_dict(other, state["buffer"])
    other.set_rng(torch.Generator())
    other.sampler._rng.set_state(state["random"])
    for _ in range(2):
        assert same(draw(other), draw(buffer))
        assert other.sampler.ran_out == buffer.sampler.ran_out
        assert other.sampler._remaining_batches == buffer.sampler._remaining_batches
    for own in (buffer, other):
        own.extend(make_steps([6, 9], 60))
    for _ in range(3):
        assert same(draw(other), draw(buffer))


def test_samplers_of_an_ensemble_go_on() -> None:
    def make() -> SamplerEnsemble:
        parts = [SamplerWithoutReplacement(), PrioritizedSampler(8, 0.6, 0.4)]
        return SamplerEnsemble(*parts, sample_from_all=True)

    first, second = make(), make()
    first._samplers[0]._sample_list = torch.tensor([3, 1])
    first._samplers[0].len_storage = 4
    first._samplers[1].extend(torch.arange(8))
    first._samplers[1].update_priority(torch.arange(8), torch.arange(1.0, 9.0))
    load_sampler_state_dict(second, sampler_state_dict(first, 0))
    assert second._samplers[0]._sample_list.tolist() == [3, 1]
    trees = [own._samplers[1]._sum_tree[torch.arange(8)] for own in (first, second)]
    torch.testing.assert_close(*trees)


# Collectors


def test_a_collector_goes_on_in_the_middle_of_episodes(tmp_path: Path) -> None:
    def make() -> Collector:
        env = make_env("hand_v2", num_envs=4, seed=3)
        return Collector(env, frames_per_batch=4 * 30, total_frames=-1)

    def batches(collector: Collector, n: int) -> TensorDict:
        torch.manual_seed(5)
        return torch.cat([collector.next() for _ in range(n)], 1)

    unbroken, other = make(), make()
    batches(unbroken, 3)  # 90 steps: 40 into the second episodes
    worlds = unbroken.env.world_state_dict()
    save_checkpoint({"collector": collector_state_dict(unbroken)}, tmp_path / "collector.pt")
    load_collector_state_dict(other, load_checkpoint(tmp_path / "collector.pt")["collector"])
    other.env.load_world_state_dict(worlds)
    expected = batches(unbroken, 2)
    assert same(batches(other, 2), expected)
    assert expected["collector", "traj_ids"].unique().tolist() == list(range(4, 12))  # of 150 steps


def test_tensors_come_where_they_are_wanted(tmp_path: Path) -> None:
    save_checkpoint({"weight": torch.ones(3)}, tmp_path / "state.pt")
    assert load_checkpoint(tmp_path / "state.pt", map_location="meta")["weight"].is_meta
    assert load_checkpoint(tmp_path / "state.pt")["weight"].tolist() == [1.0, 1.0, 1.0]
