"""Batches of a run's own transitions and of demonstrations."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from torchrl_her import GoalReward, HERWriter
from torchrl_her.demonstrations import MixedReplay, demonstration_rows, write_demonstrations
from torchrl_her.replay_buffers import (
    PackedStorage,
    RunsPrioritizedSampler,
    RunsSampler,
    rows_of_run,
    sizes_of,
)

from ..her_data import make_batch
from .walks import walks

B = 8  # rows of a batch


def make_buffer(
    seeds: range, capacity: int, *, sampler: str = "prioritized", **options: Any
) -> TensorDictReplayBuffer:
    generators = [torch.Generator().manual_seed(seed) for seed in seeds]
    shared: dict[str, Any] = {"runs": len(seeds), "generators": generators}
    return TensorDictReplayBuffer(
        storage=PackedStorage(len(seeds) * capacity),
        writer=HERWriter(GoalReward(0.5), **shared, **options),
        sampler=RunsSampler(capacity, **shared)
        if sampler == "uniform"
        else RunsPrioritizedSampler(capacity, 1.0, 1.0, **shared),
        priority_key="td_error",
    )


def collected(runs: int) -> TensorDict:
    """Episodes of a walk, numbered from 50,000 so that demonstrations are far."""
    batch = make_batch([[4, 4]] * runs).exclude("collector", "state", ("next", "state"))
    for at in (batch, batch["next"]):
        for key in ("observation", "achieved_goal", "desired_goal"):
            at[key] = at[key][..., :1] + 50_000
    return batch


def mixed(
    seeds: range = range(1), *, sampler: str = "prioritized", batch: TensorDict | None = None
) -> MixedReplay:
    """A quarter of each batch is demonstrations; each run has its own seed."""
    own = make_buffer(seeds, 100, sampler=sampler)
    shown = make_buffer(range(20 + seeds.start, 20 + seeds.stop), 60, sampler=sampler)
    for run in range(len(seeds)):
        write_demonstrations(shown, walks(3, 2), run=run)
    out = MixedReplay(own, shown, share=0.25, batch_size=B)
    out.extend(collected(len(seeds)) if batch is None else batch)
    return out


# Rows


@pytest.mark.parametrize(
    ("share", "batch_size", "rows"), [(0.125, 256, 32), (0.99, 8, 7), (0.001, 8, 1), (0.3, 10, 3)]
)
def test_how_many_rows_of_a_batch_are_demonstrations(share: float, batch_size: int, rows: int) -> None:
    assert demonstration_rows(share, batch_size) == rows


@pytest.mark.parametrize(
    ("share", "batch_size", "message"),
    [
        (0.0, 8, r"share must be in \(0, 1\), got 0.0"),
        (1.0, 8, r"share must be in \(0, 1\), got 1.0"),
        (0.5, 1, "batch_size must be at least 2 to mix two kinds of rows, got 1"),
    ],
)
def test_shares_that_leave_no_room(share: float, batch_size: int, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        demonstration_rows(share, batch_size)


@pytest.mark.parametrize("sampler", ["uniform", "prioritized"])
@pytest.mark.parametrize("runs", [1, 3])
def test_each_batch_of_each_run_has_its_share_and_marks_it(runs: int, sampler: str) -> None:
    rows = mixed(range(runs), sampler=sampler).sample(runs * 5 * B).view(runs, 5, B)
    assert (rows["demonstration"].squeeze(-1) == (torch.arange(B) >= 6)).all()
    far = rows["observation"].squeeze(-1) >= 40_000
    assert (far == (torch.arange(B) < 6)).all()
    assert rows["demonstration"].dtype == torch.bool


def test_demonstrations_are_relabeled_and_rewarded_like_all_rows() -> None:
    buffer = make_buffer(range(1), 100, k=4, strategy="final")
    write_demonstrations(buffer, walks(3, 2, goal=77.0))
    rows = buffer.storage[:]
    virtual = rows["virtual"].flatten()
    assert (int(virtual.sum()), int((~virtual).sum())) == (20, 5)
    assert set(rows["desired_goal"][virtual].flatten().tolist()) == {3.0, 102.0}
    assert rows["next", "reward"][virtual].sum() == -20 + 4 * 2  # the last step of each episode
    assert (rows["desired_goal"][~virtual] == 77).all()


def test_what_only_one_of_both_has_is_left_out() -> None:
    out = mixed()
    keys = set(out.sample(B).keys(True, True))
    assert {"demonstration", "index", "priority_weight", "virtual", ("next", "reward")} <= keys
    own = make_buffer(range(1), 100)
    own.extend(collected(1).set("log_prob", torch.zeros(1, 8)))
    assert "log_prob" in own.sample(4).keys()
    keys = set(MixedReplay(own, out.demonstrations, share=0.25, batch_size=B).sample(B).keys())
    assert "log_prob" not in keys


def test_a_share_of_the_rows_has_that_share_of_the_weight() -> None:
    out = mixed()
    rows = out.sample(3 * B)
    out.update_tensordict_priority(rows.select("index").set("td_error", torch.rand(3 * B) + 0.01))
    rows = out.sample(64 * B).view(64, B)
    weight = rows["priority_weight"]
    assert weight.std() > 0.1
    assert weight[:, :6].mean().item() == pytest.approx(1.0, abs=1e-5)
    assert weight[:, 6:].mean().item() == pytest.approx(1.0, abs=1e-5)


# Priorities


def values(buffer: TensorDictReplayBuffer, run: int = 0) -> Tensor:
    return buffer.sampler.state_dict()["values"][run]


@pytest.mark.parametrize("runs", [1, 2])
def test_new_priorities_go_to_the_buffer_that_a_row_is_of(runs: int) -> None:
    out = mixed(range(runs))
    rows = out.sample(runs * 4 * B)
    rows.set("td_error", rows["index"].float() + 1)
    out.update_tensordict_priority(rows)
    for buffer, offset, capacity in ((out.collected, 0, 100), (out.demonstrations, runs * 100, 60)):
        own = rows["index"][(rows["demonstration"].flatten()) == (offset > 0)] - offset
        for run in range(runs):
            place = own[(own >= run * capacity) & (own < (run + 1) * capacity)].unique()
            assert len(place) > 3
            expected = place.float() + 1 + offset
            torch.testing.assert_close(values(buffer, run)[place - run * capacity], expected)
    assert len(out.demonstrations) == len(out.demonstrations.storage)


def test_rows_of_some_runs_alone_may_be_updated() -> None:
    out = mixed(range(2))
    rows = out.sample(2 * B)
    before = [values(buffer, 0).clone() for buffer in (out.collected, out.demonstrations)]
    last = rows.view(2, B)[1].select("index").set("td_error", torch.full((B,), 9.0))
    out.update_tensordict_priority(last)
    after = [values(buffer, 0) for buffer in (out.collected, out.demonstrations)]
    assert all(torch.equal(one, other) for one, other in zip(before, after, strict=True))
    assert (values(out.demonstrations, 1) == 9).any()


# Runs


def test_runs_side_by_side_draw_what_they_draw_alone() -> None:
    together, batch = mixed(range(3)), collected(3)
    alone = [mixed(range(run, run + 1), batch=batch[run : run + 1]) for run in range(3)]
    rows = together.sample(3 * 4 * B).view(3, -1)
    for run, own in enumerate(alone):
        single = own.sample(4 * B)
        for key in ("observation", "desired_goal", "demonstration", ("next", "reward")):
            assert torch.equal(rows[run][key], single[key]), (run, key)
    assert sizes_of(together.demonstrations) == [25] * 3
    written = [rows_of_run(together.demonstrations, run)["desired_goal"] for run in range(3)]
    assert not torch.equal(written[0], written[1])  # their goals are drawn for each


def test_it_shows_the_size_and_the_writer_of_the_own_buffer() -> None:
    out = mixed(range(2))
    assert len(out) == len(out.collected)
    assert out.writer is out.collected.writer
    assert sizes_of(out) == sizes_of(out.collected)  # type: ignore[arg-type]
    assert out.priority_key == "td_error"


# What it refuses


def test_what_is_no_whole_number_of_batches_is_refused() -> None:
    with pytest.raises(ValueError, match="batch_size must be a positive multiple of 8, got 12"):
        mixed().sample(12)
    with pytest.raises(ValueError, match="batch_size must be a positive multiple of 8, got 0"):
        mixed().sample(0)


def test_buffers_of_other_numbers_of_runs_are_refused() -> None:
    with pytest.raises(ValueError, match="buffers must have the same number of runs, got 2 and 1"):
        MixedReplay(make_buffer(range(2), 10), make_buffer(range(1), 10), batch_size=B)


def test_runs_without_demonstrations_are_refused() -> None:
    own, shown = make_buffer(range(2), 100), make_buffer(range(2), 100)
    own.extend(collected(2))
    write_demonstrations(shown, walks(3), run=1)
    with pytest.raises(RuntimeError, match="some runs have no demonstrations"):
        MixedReplay(own, shown, share=0.5, batch_size=B).sample(2 * B)


def test_a_buffer_that_does_not_relabel_is_refused() -> None:
    plain = TensorDictReplayBuffer(storage=LazyTensorStorage(9))
    with pytest.raises(TypeError, match="demonstrations need a buffer with a HERWriter, got a Tensor"):
        write_demonstrations(plain, walks(3))
