"""Samplers of several runs: how often rows are drawn, and that runs do not reach each other."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer, TensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import PrioritizedSampler

from torchrl_her.replay_buffers import RunsPrioritizedSampler, RunsSampler

RUNS, CAPACITY = 3, 40
BOTH = pytest.mark.parametrize("kind", ["uniform", "prioritized"])


def generators(runs: int = RUNS) -> list[torch.Generator]:
    return [torch.Generator().manual_seed(run) for run in range(runs)]


def make(kind: str, runs: int = RUNS, **options: Any) -> Any:
    options = {"runs": runs, "generators": generators(runs), **options}
    if kind == "uniform":
        return RunsSampler(CAPACITY, **options)
    return RunsPrioritizedSampler(CAPACITY, 0.7, 0.5, **options)


def storage(runs: int = RUNS) -> LazyTensorStorage:
    return LazyTensorStorage(runs * CAPACITY)


def rows(*sizes: int) -> torch.Tensor:
    """The first rows of each run's block."""
    return torch.cat([torch.arange(size) + run * CAPACITY for run, size in enumerate(sizes)])


@BOTH
def test_what_a_run_draws_is_what_it_draws_alone(kind: str) -> None:
    together, sizes = make(kind), (10, 40, 1)
    together.mark_update(rows(*sizes))
    alone = [make(kind, 1, generators=[generator]) for generator in generators()]
    for own, size in zip(alone, sizes, strict=True):
        own.mark_update(torch.arange(size))
    for step in range(3):
        index, info = together.sample(storage(), 3 * 8)
        for run, own in enumerate(alone):
            single, single_info = own.sample(storage(1), 8)
            assert torch.equal(index.view(3, -1)[run] - run * CAPACITY, single)
            if kind == "prioritized":
                priority = (single + 1.0 + step) ** (run + 1)
                weight = info["priority_weight"].view(3, -1)[run]
                assert torch.equal(weight, single_info["priority_weight"])
                own.update_priority(single, priority)
                together.update_priority(single + run * CAPACITY, priority)


@BOTH
def test_a_run_without_rows_gets_those_of_another_and_draws_no_random_numbers(kind: str) -> None:
    sampler, full = make(kind), make(kind)
    sampler.mark_update(rows(0, 5, 7))
    full.mark_update(rows(3, 5, 7))
    before = sampler.generators[0].get_state()
    index, info = sampler.sample(storage(), 3 * 8)
    blocks, expected = index.view(3, -1), full.sample(storage(), 3 * 8)[0].view(3, -1)
    assert torch.equal(blocks[0], blocks[1])
    assert torch.equal(blocks[1:], expected[1:])
    assert torch.equal(sampler.generators[0].get_state(), before)
    if kind == "prioritized":
        assert info["priority_weight"].isfinite().all()


@BOTH
def test_emptying_a_run_leaves_the_others(kind: str) -> None:
    sampler, other = make(kind), make(kind)
    for own in (sampler, other):
        own.mark_update(rows(10, 10, 10))
        if kind == "prioritized":
            own.update_priority(rows(10, 10, 10), torch.arange(30.0))
    sampler.empty_run(1)
    sampler.mark_update(torch.tensor([CAPACITY + 2]))
    blocks, expected = (own.sample(storage(), 3 * 50)[0].view(3, -1) for own in (sampler, other))
    assert torch.equal(blocks[[0, 2]], expected[[0, 2]])
    if kind == "prioritized":
        assert blocks[1].unique().tolist() == [CAPACITY + 2]
        assert sampler.default_priority.tolist() == [9.0, 1.0, 29.0]


def test_uniform_rows_are_equally_likely() -> None:
    sampler = make("uniform")
    sampler.mark_update(rows(4, 8, 40))
    counts = sampler.sample(storage(), 3 * 40_000)[0].bincount(minlength=RUNS * CAPACITY).view(3, -1)
    for own, size in zip(counts / 40_000, (4, 8, 40), strict=True):
        torch.testing.assert_close(own[:size], torch.full((size,), 1 / size), atol=0.01, rtol=0)
        assert own[size:].sum() == 0


def test_rows_are_drawn_by_priority_and_weighted_as_torchrl_does() -> None:
    """One run: frequencies, and weights that differ from TorchRL's by a factor for the whole batch."""
    sampler, theirs = make("prioritized", 1), PrioritizedSampler(CAPACITY, 0.7, 0.5)
    theirs._rng = torch.Generator().manual_seed(0)
    place, priority = torch.arange(10), torch.arange(10.0) ** 2
    full = LazyTensorStorage(CAPACITY)
    full.set(torch.arange(10), torch.zeros(10))
    for own in (sampler, theirs):
        own.mark_update(place, storage=full)
        own.update_priority(place, priority, storage=full)
    index, info = sampler.sample(full, 100_000)
    p = (priority + 1e-8) ** 0.7
    torch.testing.assert_close(index.bincount() / 100_000, p[: index.max() + 1] / p.sum(), atol=0.01, rtol=0)
    drawn, their_info = theirs.sample(full, 2_000)
    weight_of = torch.zeros(10).index_put_((drawn,), their_info["priority_weight"])
    own, own_weight = index[:2_000], info["priority_weight"][:2_000]
    known = weight_of[own] > 0
    ratio = own_weight[known] / weight_of[own][known]
    torch.testing.assert_close(ratio, ratio[:1].expand_as(ratio))
    assert info["priority_weight"].max() == 1.0


def test_torchs_default_dtype_makes_no_difference() -> None:
    draws = []
    try:
        for dtype in (torch.float32, torch.float64):
            torch.set_default_dtype(dtype)
            sampler = make("prioritized")
            sampler.mark_update(rows(10, 40, 1))
            sampler.update_priority(rows(10, 40, 1), torch.arange(1, 52))
            index, info = sampler.sample(storage(), 3 * 8)
            draws.append((index, info["priority_weight"]))
    finally:
        torch.set_default_dtype(torch.float32)
    assert all(map(torch.equal, *draws))


def test_the_sign_of_a_priority_does_not_matter_and_minus_one_is_no_row() -> None:
    sampler = make("prioritized", 1, generators=None)
    sampler.mark_update(torch.arange(3))
    sampler.update_priority(torch.tensor([0, -1, 2]), torch.tensor([-8.0, 1e9, 0.0]))
    state = sampler.state_dict()
    torch.testing.assert_close(state["values"][0], torch.tensor([8.0, 1.0, 1e-8]) ** 0.7)
    assert sampler.default_priority == 8.0


def test_new_rows_get_the_largest_priority_that_their_run_has_seen() -> None:
    sampler = make("prioritized")
    sampler.mark_update(rows(2, 2, 2))
    sampler.update_priority(torch.tensor([CAPACITY]), torch.tensor([5.0]))
    sampler.update_priority(torch.tensor([CAPACITY]), torch.tensor([0.5]))  # the largest one stays
    sampler.mark_update(rows(3, 3, 3))
    newest = [values[-1].item() for values in sampler.state_dict()["values"]]
    assert newest == pytest.approx([1.0, 5.0**0.7, 1.0])


def test_a_buffer_takes_priorities_from_tensordicts() -> None:
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(CAPACITY),
        sampler=RunsPrioritizedSampler(CAPACITY, 1.0, 1.0),
        batch_size=64,
        priority_key="td_error",
    )
    buffer.set_rng(torch.Generator().manual_seed(0))
    buffer.extend(TensorDict({"x": torch.arange(5.0)}, [5]))
    batch = buffer.sample()
    batch["td_error"] = (batch["x"] == 3).float().unsqueeze(-1) * 100
    buffer.update_tensordict_priority(batch)
    assert buffer.sample()["x"].unique().tolist() == [3.0]


@BOTH
def test_a_file_brings_the_same_draws_back(kind: str, tmp_path: Path) -> None:
    sampler, other = make(kind), make(kind)
    sampler.mark_update(rows(10, 0, 40))
    if kind == "prioritized":
        sampler.update_priority(rows(10, 0, 40), torch.arange(50.0))
    sampler.dumps(tmp_path / "sampler")
    other.loads(tmp_path / "sampler")
    index, info = sampler.sample(storage(), 3 * 16)
    again, info_again = other.sample(storage(), 3 * 16)
    assert torch.equal(index, again)
    assert all(torch.equal(info[key], info_again[key]) for key in info)
    with pytest.raises(ValueError, match="the state must have 2 runs, got 3"):
        make(kind, 2).load_state_dict(sampler.state_dict())


@BOTH
def test_the_state_of_a_larger_buffer_is_refused(kind: str) -> None:
    sampler = make(kind)
    state = {**sampler.state_dict(), "sizes": torch.tensor([CAPACITY, CAPACITY + 1, 0])}
    with pytest.raises(ValueError, match="the state must have at most 40 rows of each run, got 41"):
        sampler.load_state_dict(state)


@BOTH
def test_what_cannot_be_is_refused(kind: str) -> None:
    with pytest.raises(ValueError, match="runs must be at least 1, got 0"):
        make(kind, 0, generators=None)
    with pytest.raises(ValueError, match="3 runs need 3 generators, one for each run, got None"):
        make(kind, generators=None)
    with pytest.raises(ValueError, match="3 runs need 3 generators, one for each run, got 2"):
        make(kind, generators=generators(2))
    sampler = make(kind)
    with pytest.raises(RuntimeError, match="an empty buffer cannot be sampled from"):
        sampler.sample(storage(), 6)
    sampler.mark_update(rows(1, 1, 1))
    with pytest.raises(ValueError, match="batch_size must be a multiple of 3 runs, got 7"):
        sampler.sample(storage(), 7)
    with pytest.raises(ValueError, match="must have 3 blocks of 40 rows, got one of 40 rows"):
        sampler.sample(storage(1), 6)


def test_alpha_stays_once_there_are_priorities() -> None:
    sampler = make("prioritized")
    sampler.alpha = 0.2
    sampler.mark_update(rows(1, 1, 1))
    sampler.alpha = 0.2
    with pytest.raises(ValueError, match="alpha is 0.2 and cannot become 0.5"):
        sampler.alpha = 0.5


def test_emptying_the_buffer_empties_all_runs() -> None:
    sampler = RunsPrioritizedSampler(CAPACITY, 0.5, 0.5)
    buffer = ReplayBuffer(storage=LazyTensorStorage(CAPACITY), sampler=sampler, batch_size=64)
    buffer.extend(torch.arange(5))
    buffer.update_priority(torch.arange(5), torch.full((5,), 7.0))
    buffer.empty()
    assert sampler.default_priority == 1.0
    buffer.extend(torch.arange(2))
    assert set(buffer.sample().tolist()) == {0, 1}


@pytest.mark.parametrize("native", [True, False], ids=["compiled", "tensors"])
@pytest.mark.parametrize("priority", [0.0, 1e-38], ids=["zero", "too small for a power"])
def test_a_run_whose_priorities_are_all_zero_draws_its_rows_evenly(priority: float, native: bool) -> None:
    options: dict[str, Any] = {"runs": RUNS, "generators": generators(), "eps": 0.0}
    sampler, other = (RunsPrioritizedSampler(CAPACITY, 2.0, 0.5, **options) for _ in range(2))
    other.generators = generators()
    for own in (sampler, other):
        own._trees.native = native
        own.mark_update(rows(5, 40, 7))
    sampler.update_priority(rows(5), torch.tensor(priority))
    index, info = sampler.sample(storage(), 3 * 5_000)
    blocks, weight = index.view(3, -1), info["priority_weight"].view(3, -1)
    counts = blocks[0].bincount(minlength=5)
    assert len(counts) == 5
    torch.testing.assert_close(counts / 5_000, torch.full((5,), 0.2), atol=0.03, rtol=0)
    assert (weight == 1.0).all()
    assert torch.equal(blocks[1:], other.sample(storage(), 3 * 5_000)[0].view(3, -1)[1:])


def test_priorities_of_rows_that_were_not_written_are_left_out() -> None:
    sampler = make("prioritized")
    sampler.mark_update(rows(30, 20, 10))
    sampler.empty_run(1)
    sampler.update_priority(rows(30, 20, 11), torch.full((61,), 9.0))  # as they were drawn before
    assert sampler.state_dict()["sizes"].tolist() == [30, 0, 10]
    assert sampler.default_priority.tolist() == [9.0, 1.0, 9.0]
    blocks = sampler.sample(storage(), 3 * 200)[0].view(3, -1)
    assert torch.equal(blocks[1], blocks[0])
    assert blocks[2].max() < 2 * CAPACITY + 10
    sampler.mark_update(torch.tensor([CAPACITY]))
    sampler.update_priority(torch.tensor([CAPACITY + 1, 0]), torch.tensor([50.0, 70.0]))
    assert sampler.default_priority.tolist() == [70.0, 1.0, 9.0]
    assert sampler.sample(storage(), 3 * 200)[0].view(3, -1)[1].unique().tolist() == [CAPACITY]


def test_a_buffer_around_a_filled_storage_can_be_sampled() -> None:
    full = LazyTensorStorage(CAPACITY)
    full.set(slice(0, 6), torch.arange(6))
    sampler = RunsPrioritizedSampler(CAPACITY, 1.0, 1.0)
    buffer = ReplayBuffer(storage=full, sampler=sampler, batch_size=200)
    assert buffer.sample().unique().tolist() == list(range(6))
    buffer.empty()
    buffer.update_priority(torch.arange(6), torch.ones(6))
    with pytest.raises(RuntimeError, match="an empty buffer cannot be sampled from"):
        buffer.sample()


@pytest.mark.parametrize("alpha", [0.0, 0.7, 2.0])
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_priorities_that_are_not_finite_are_ignored(value: float, alpha: float) -> None:
    sampler = RunsPrioritizedSampler(CAPACITY, alpha, 0.5, runs=RUNS, generators=generators())
    sampler.mark_update(rows(5, 5, 5))
    given = torch.full((15,), 2.0)
    given[[6, 8]] = value
    with pytest.warns(RuntimeWarning, match="run 1 was given priorities that are not finite") as told:
        sampler.update_priority(rows(5, 5, 5), given)
    assert len(told) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sampler.update_priority(rows(5, 5, 5), given)
    assert sampler.default_priority.tolist() == [2.0, 2.0, 2.0]
    expected = torch.tensor([2.0, 1.0, 2.0, 1.0, 2.0]) ** alpha
    torch.testing.assert_close(sampler.state_dict()["values"][1], expected)
    index, info = sampler.sample(storage(), 3 * 200)
    assert index.view(3, -1)[1].unique().tolist() == list(range(CAPACITY, CAPACITY + 5))
    assert info["priority_weight"].isfinite().all()


def test_priorities_whose_power_is_not_finite_are_ignored() -> None:
    sampler = RunsPrioritizedSampler(CAPACITY, 3.0, 0.5)
    sampler.mark_update(torch.arange(3))
    with pytest.warns(RuntimeWarning, match="run 0"):
        sampler.update_priority(torch.tensor([1]), torch.tensor([1e30]))
    assert sampler.default_priority == 1.0
    assert sampler.sample(storage(1), 200)[0].unique().tolist() == [0, 1, 2]
