"""Running statistics: right for any order and split of the values, and apart for each run."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import Tensor

from torchrl_her.modules import RunningNorm
from torchrl_her.modules.normalization import Moments, merge, moments, normalize

NUMBERS = st.floats(-1e3, 1e3, allow_nan=False, width=32)


def rows(*values: float, goals: list[float] | None = None) -> TensorDict:
    seen = torch.tensor(values).unsqueeze(-1)
    wanted = torch.tensor(goals or [0.0] * len(values)).unsqueeze(-1)
    return TensorDict({"observation": seen, "desired_goal": wanted}, [len(values)])


def make_norm(**options: Any) -> RunningNorm:
    return RunningNorm({"observation": 1, "desired_goal": 1}, **options)


# The numbers


def test_moments_are_those_computed_by_hand() -> None:
    n, mean, var = moments(torch.tensor([[1.0, -4.0], [2.0, -4.0], [6.0, -4.0]]))
    assert n.tolist() == [3.0, 3.0]
    assert mean.tolist() == [3.0, -4.0]
    torch.testing.assert_close(var, torch.tensor([14.0 / 3.0, 0.0], dtype=torch.float64))


@given(st.lists(NUMBERS, min_size=1, max_size=30), st.lists(st.integers(0, 30), max_size=5))
def test_merged_parts_have_the_moments_of_the_whole(values: list[float], cuts: list[int]) -> None:
    whole = torch.tensor(values, dtype=torch.float64).unsqueeze(-1)
    borders = [0, *sorted(min(cut, len(values)) for cut in cuts), len(values)]
    merged = nothing()
    for begin, end in pairwise(borders):
        merged = merge(merged, moments(whole[begin:end]) if begin < end else nothing())
    for one, other in zip(merged, moments(whole), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-6)


def nothing() -> Moments:
    """Of no values; what mean and variance are then does not count."""
    return Moments(*(torch.tensor(own, dtype=torch.float64) for own in ([0.0], [7.0], [3.0])))


def test_numbers_far_from_zero_keep_their_variance() -> None:
    norm = make_norm()
    for _ in range(100):
        norm.update(rows(1e4 + 0.5, 1e4 - 0.5))
    torch.testing.assert_close(norm.moments_of("observation").var, torch.tensor([0.25], dtype=torch.float64))


def test_values_are_clipped_on_both_sides() -> None:
    out = normalize(torch.tensor([-9.0, 0.0, 3.0, 9.0]), *(torch.tensor(own) for own in (1.0, 2.0, 3.0)))
    assert out.tolist() == [-3.0, -0.5, 1.0, 3.0]


# RunningNorm


def test_each_entry_is_normalized_by_its_own_mean_and_deviation() -> None:
    norm = make_norm()
    norm.update(rows(1.0, 5.0, goals=[10.0, 10.0]))
    norm.update(rows(3.0, 3.0, goals=[20.0, 40.0]))
    assert norm.moments_of("observation").mean.tolist() == [3.0]
    assert norm.moments_of("desired_goal").mean.tolist() == [20.0]
    out = norm(rows(3.0 + math.sqrt(2.0), 3.0, goals=[20.0, 20.0 - math.sqrt(150.0)]))
    torch.testing.assert_close(out["observation"], torch.tensor([[1.0], [0.0]]))
    torch.testing.assert_close(out["desired_goal"], torch.tensor([[0.0], [-1.0]]))


def test_next_is_normalized_like_the_root_and_nothing_else_is_touched() -> None:
    norm = make_norm()
    norm.update(rows(1.0, 5.0))
    batch = rows(5.0, 3.0).set("action", torch.ones(2, 1)).set("next", rows(1.0, 1.0))
    out = norm(batch)
    assert out["observation"].tolist() == [[1.0], [0.0]]
    assert out["next", "observation"].tolist() == [[-1.0], [-1.0]]
    assert out["action"] is batch["action"]
    assert batch["observation"].tolist() == [[5.0], [3.0]]  # what was given stays
    assert batch["next", "observation"].tolist() == [[1.0], [1.0]]


def test_before_anything_was_counted_nothing_is_changed() -> None:
    batch = rows(1e6, -1e6)
    assert torch.equal(make_norm()(batch)["observation"], batch["observation"])


def test_entries_that_hardly_change_are_not_blown_up() -> None:
    norm = make_norm(least_std=0.1)
    norm.update(rows(2.0, 2.0))
    torch.testing.assert_close(norm(rows(2.01))["observation"], torch.tensor([[0.1]]))


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_the_unit_of_values_makes_no_difference(unit: float) -> None:
    norm, plain = make_norm(), make_norm()
    plain.update(rows(3.0, 3.002, 2.998))
    norm.update(rows(3.0 * unit, 3.002 * unit, 2.998 * unit))
    wanted = plain(rows(3.001, 50.0))["observation"]
    torch.testing.assert_close(
        norm(rows(3.001 * unit, 50.0 * unit))["observation"], wanted, rtol=1e-2, atol=0
    )
    assert wanted[1].item() == norm.clip


def test_constant_entries_become_zero_until_they_change() -> None:
    norm = make_norm()
    norm.update(rows(3.0, 3.0))
    assert norm(rows(3.0, 3.0003))["observation"].flatten().tolist() == [0.0, pytest.approx(1.0, rel=1e-2)]


def test_values_may_count_more_often_than_once() -> None:
    norm = make_norm()
    norm.update(rows(0.0, goals=[8.0]))
    norm.count("desired_goal", torch.tensor([[0.0]]), weight=3.0)
    n, mean, var = norm.moments_of("desired_goal")  # of 8, 0, 0, 0
    assert (n.tolist(), mean.tolist(), var.tolist()) == ([4.0], [2.0], [12.0])
    assert norm.moments_of("observation").n.item() == 1.0


def test_using_it_does_not_change_it_in_either_mode() -> None:
    norm = make_norm()
    norm.update(rows(1.0, 5.0))
    before = {key: value.clone() for key, value in norm.state_dict().items()}
    for training in (True, False):
        norm.train(training)(rows(100.0))
    assert all(torch.equal(before[key], value) for key, value in norm.state_dict().items())


def test_a_frozen_one_counts_nothing() -> None:
    norm = make_norm()
    norm.update(rows(1.0, 5.0))
    norm.frozen = True
    norm.update(rows(100.0))
    norm.count("observation", torch.tensor([[100.0]]))
    assert norm.moments_of("observation").mean.tolist() == [3.0]
    norm.frozen = False
    norm.update(rows(0.0))
    assert norm.moments_of("observation").mean.tolist() == [2.0]


def test_runs_have_statistics_of_their_own() -> None:
    norm = make_norm(runs=3)
    norm.update(rows(1.0, 5.0, 7.0), [0, 2], [2, 1])
    assert [norm.moments_of("observation", run).n.item() for run in range(3)] == [2.0, 0.0, 1.0]
    out = norm(rows(5.0, 5.0, 5.0))["observation"]
    assert out.tolist() == [[1.0], [5.0], [-5.0]]  # the second run has not begun, the third is clipped
    norm.update(rows(0.0, 0.0, 9.0, 9.0, 7.0, 7.0))  # equal blocks
    assert norm.moments_of("observation", 0).mean.tolist() == [1.5]
    assert norm.moments_of("observation", 1).mean.tolist() == [9.0]
    norm.restart(1)
    assert [norm.moments_of("observation", run).n.item() for run in range(3)] == [4.0, 0.0, 3.0]
    assert norm(rows(2.0, 2.0, 7.0))["observation"][1].tolist() == [2.0]


def test_some_numbers_of_an_entry_may_be_counted_and_forgotten_alone() -> None:
    norm = RunningNorm({"x": 1, "input": 3})
    norm.count("input", torch.tensor([[2.0, 8.0], [4.0, 8.0]]))
    assert norm.moments_of("input").n.tolist() == [2.0, 2.0, 0.0]
    assert norm.normalize("input", torch.tensor([[2.0, 8.0, 99.0]])).tolist() == [[-1.0, 0.0, 99.0]]
    norm.count("x", torch.tensor([[1.0]]))
    norm.restart(key="input", places=[0])
    assert norm.n.tolist() == [[1.0, 0.0, 2.0, 0.0]]
    norm.restart(key="input")
    assert norm.n.tolist() == [[1.0, 0.0, 0.0, 0.0]]
    with pytest.raises(ValueError, match="'input' must have a width of at most 3, got 4"):
        norm.count("input", torch.ones(1, 4))


@pytest.mark.parametrize("runs", [1, 2])
def test_batches_may_have_any_shape(runs: int) -> None:
    norm, values = make_norm(runs=runs), torch.randn(4, 3, 1)
    batch = TensorDict({"observation": values, "desired_goal": values}, [4, 3])
    norm.update(batch)
    blocks: list[Tensor] = [own.flatten() for own in values.chunk(runs)]
    expected = [(own - own.mean()) / own.std(correction=0) for own in blocks]
    torch.testing.assert_close(norm(batch)["observation"].flatten(), torch.cat(expected))


def test_statistics_are_saved_and_loaded() -> None:
    norm, other = make_norm(runs=2), make_norm(runs=2)
    norm.update(rows(1.0, 5.0, 7.0, 9.0))
    other.load_state_dict(norm.state_dict())
    batch = rows(0.0, 8.5)
    assert torch.equal(norm(batch)["observation"], other(batch)["observation"])
    for each in (norm, other):
        each.update(batch)
    assert torch.equal(norm.moments_of("observation", 1).var, other.moments_of("observation", 1).var)


def test_nested_keys_and_double_precision() -> None:
    norm = RunningNorm({("agent", "seen"): 2})
    batch = TensorDict({"agent": {"seen": torch.tensor([[1.0, 0.0], [3.0, 4.0]]).double()}}, [2])
    norm.update(batch)
    out = norm(batch)["agent", "seen"]
    assert out.dtype is torch.float64
    assert out.tolist() == [[-1.0, -1.0], [1.0, 1.0]]


@pytest.mark.parametrize(
    ("widths", "options", "message"),
    [
        ({}, {}, "at least one entry to normalize, got none"),
        ({"x": 0}, {}, "the width of 'x' must be at least 1, got 0"),
        ({"x": 1}, {"runs": 0}, "runs must be at least 1, got 0"),
        ({"x": 1}, {"clip": 0.0}, r"clip must be above 0, got 0\.0"),
        ({"x": 1}, {"least_std": math.nan}, "least_std must be above 0, got nan"),
    ],
)
def test_options_that_cannot_be(widths: Any, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        RunningNorm(widths, **options)


def test_batches_that_cannot_be() -> None:
    norm = make_norm(runs=2)
    with pytest.raises(ValueError, match="'observation' must be finite to be counted, got NaN"):
        norm.update(rows(1.0, math.nan))
    with pytest.raises(ValueError, match="must be finite"):
        norm.update(rows(1.0, math.inf))
    for use in (norm, norm.update):
        with pytest.raises(ValueError, match=r"must be 2 equal blocks, .* got a batch of \[3\]"):
            use(rows(1.0, 2.0, 3.0))
        with pytest.raises(KeyError, match="needs the entry 'desired_goal', got .'observation'"):
            use(rows(1.0, 2.0).exclude("desired_goal"))
        wide = rows(1.0, 2.0).set("observation", torch.ones(2, 5))
        with pytest.raises(ValueError, match="'observation' must have a width of 1, got 5"):
            use(wide)
    with pytest.raises(KeyError, match="'action' is not normalized, only 'observation', 'desired_goal'"):
        norm.normalize("action", torch.ones(2, 1))


def test_whole_numbers_are_normalized_to_numbers_with_digits() -> None:
    norm = make_norm()
    norm.update(rows(1.0, 2.0))
    batch = rows(0.0, 0.0).set("observation", torch.tensor([[1], [2]]))
    out = norm(batch)["observation"]
    assert out.dtype is torch.get_default_dtype()
    assert out.tolist() == [[-1.0], [1.0]]
    assert norm.normalize("observation", torch.tensor([[True]])).tolist() == [[-1.0]]
    assert norm.normalize("observation", torch.tensor([[2.0]]).half()).dtype is torch.float16


@pytest.mark.parametrize("runs", [1, 2])
def test_rows_that_cannot_be_counted_leave_the_statistics_as_they_were(runs: int) -> None:
    norm = make_norm(runs=runs)
    norm.update(rows(1.0, 5.0))
    before = norm.state_dict()["n"].clone()
    with pytest.raises(ValueError, match="'desired_goal' must be finite"):
        norm.update(rows(1.0, 5.0, goals=[0.0, math.inf]))
    with pytest.raises(KeyError, match="needs the entry 'desired_goal'"):
        norm.update(rows(1.0, 5.0).exclude("desired_goal"))
    with pytest.raises(ValueError, match="'desired_goal' must have a width of 1, got 3"):
        norm.update(rows(1.0, 5.0).set("desired_goal", torch.ones(2, 3)))
    assert torch.equal(norm.n, before)
    norm.update(rows(1.0, 5.0))
    assert torch.equal(norm.n, 2 * before)


@pytest.mark.parametrize("weight", [-1.0, math.nan, math.inf])
def test_weights_of_values_that_cannot_be(weight: float) -> None:
    norm = make_norm()
    with pytest.raises(ValueError, match=f"weight must be at least 0 and finite, got {weight}"):
        norm.count("observation", torch.ones(2, 1), weight=weight)
    assert norm.n.tolist() == [[0.0, 0.0]]
