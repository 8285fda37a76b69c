"""The factors that goals are drawn by, and the draw."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from torchrl_her.goals import candidate_range, candidates, combine, draw, draw_uniformly, draw_weighted


@pytest.mark.parametrize(
    ("strategy", "expected"),
    [
        ("future", [[1, 1, 1, 0], [0, 1, 1, 0], [0, 0, 1, 0], [0, 0, 0, 0]]),
        ("final", [[0, 0, 1, 0], [0, 0, 1, 0], [0, 0, 1, 0], [0, 0, 0, 0]]),
        ("episode", [[1, 1, 1, 0], [1, 1, 1, 0], [1, 1, 1, 0], [0, 0, 0, 0]]),
    ],
)
def test_candidates_of_an_episode_of_three_padded_to_four(strategy: str, expected: list[list[int]]) -> None:
    assert candidates(strategy, torch.tensor([3]), 4)[0].int().tolist() == expected


def test_candidates_take_any_batch_shape() -> None:
    lengths = torch.tensor([[1, 2], [3, 4]])
    mask = candidates("future", lengths, 4)
    assert mask.shape == (2, 2, 4, 4)
    assert torch.equal(mask[1, 0], candidates("future", torch.tensor(3), 4))


def test_factors_multiply() -> None:
    candidate = torch.tensor([[True, True], [False, True]])
    keep = torch.tensor([[False, True], [True, True]])
    assert combine(candidate, torch.tensor([2.0, 3.0]), keep).tolist() == [[0.0, 3.0], [0.0, 3.0]]
    assert combine(candidate).tolist() == [[1.0, 1.0], [0.0, 1.0]]


def test_goals_are_drawn_in_proportion() -> None:
    likelihood = torch.tensor([[1.0, 0.0, 3.0]])
    index, valid = draw(likelihood, 40_000, generator=torch.Generator().manual_seed(0))
    share = torch.bincount(index[0], minlength=3) / 40_000
    assert valid.tolist() == [True]
    assert share[1] == 0
    assert share[2].item() == pytest.approx(0.75, abs=0.01)  # 0.01 is more than four standard deviations


def test_a_row_without_candidates_gets_none_and_no_nan() -> None:
    index, valid = draw(torch.tensor([[0.0, 0.0], [0.0, 1.0]]), 3)
    assert valid.tolist() == [False, True]
    assert ((index >= 0) & (index < 2)).all()


@settings(max_examples=100, deadline=None)
@given(
    npst.arrays("float32", (4, 9), elements=st.sampled_from([0.0, 0.0, 1e-30, 1e-6, 0.1, 1.0, 3.0, 1e6])),
    st.integers(0, 2**31),
)
def test_goals_of_weight_zero_are_never_drawn(weights: object, seed: int) -> None:
    likelihood = torch.as_tensor(weights)
    index, valid = draw(likelihood, 64, generator=torch.Generator().manual_seed(seed))
    assert torch.equal(valid, likelihood.sum(-1) > 0)
    assert (likelihood.gather(-1, index)[valid] > 0).all()


def test_even_the_largest_random_number_draws_a_goal_that_may_be_drawn(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    largest = 1.0 - 2.0**-24
    monkeypatch.setattr(torch, "rand", lambda *shape, **_: torch.full(shape, largest))
    index, _ = draw(torch.tensor([[1.0, 1.0, 1.0, 0.0]]), 1)
    assert index.item() == 2


@pytest.mark.parametrize("strategy", ["future", "final", "episode"])
def test_drawing_all_alike_is_drawing_from_the_candidates(strategy: str) -> None:
    lengths, n = torch.tensor([1, 4]), 20_000
    table = candidates(strategy, lengths, 4).float()  # type: ignore[arg-type]
    for episode, time in ((0, 0), (1, 0), (1, 1), (1, 3)):
        edges = candidate_range(strategy, torch.tensor(time), lengths[episode])  # type: ignore[arg-type]
        index = draw_uniformly(*edges, n, generator=torch.Generator().manual_seed(0))
        share = torch.bincount(index, minlength=4) / n
        expected = table[episode, time] / table[episode, time].sum()
        assert share.tolist() == pytest.approx(expected.tolist(), abs=0.02)  # six standard deviations
        assert torch.equal(share > 0, expected > 0)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**24), st.integers(1, 2**24))
def test_even_the_largest_random_number_stays_in_the_window(first: int, size: int) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch, "rand", lambda *shape, **_: torch.full(shape, 1.0 - 2.0**-24))
        index = draw_uniformly(torch.tensor(first), torch.tensor(first + size), 1)
    assert first <= index.item() < first + size


@given(
    weights=st.lists(st.sampled_from([0.0, 0.5, 1.0, 3.0]), min_size=2, max_size=6),
    seed=st.integers(0, 1000),
)
def test_weighted_draws_stay_in_their_window_and_avoid_weight_zero(weights: list[float], seed: int) -> None:
    weight, horizon = torch.tensor(weights), len(weights)
    first = torch.arange(horizon)
    end = torch.full_like(first, horizon)
    index = draw_weighted(weight, first, end, 50, generator=torch.Generator().manual_seed(seed))
    assert (index >= first.unsqueeze(-1)).all()
    assert (index < horizon).all()
    for step in range(horizon):
        if weight[step:].sum() > 0:
            assert (weight[index[step]] > 0).all()


def test_weighted_draws_follow_the_weights() -> None:
    weight = torch.tensor([[5.0, 1.0, 3.0], [0.0, 2.0, 2.0]])
    first, end = torch.tensor([[0, 1], [0, 2]]), torch.tensor([[3, 3], [2, 3]])
    index = draw_weighted(weight, first, end, 90_000, generator=torch.Generator().manual_seed(0))
    share = torch.nn.functional.one_hot(index, 3).float().mean(2)
    expected = torch.tensor([[[5 / 9, 1 / 9, 3 / 9], [0, 1 / 4, 3 / 4]], [[0, 1, 0], [0, 0, 1]]])
    torch.testing.assert_close(share, expected, atol=0.01, rtol=0)


def test_weighted_draws_do_not_lose_what_is_small() -> None:
    weight = torch.exp(-torch.arange(50.0) / 2)  # over ten orders of magnitude
    first, end = torch.tensor([30]), torch.tensor([50])
    generator = torch.Generator().manual_seed(0)
    index = draw_weighted(weight, first, end, 100_000, generator=generator)
    share = torch.nn.functional.one_hot(index[0], 50).double().mean(0)
    expected = weight.double() * (torch.arange(50) >= 30)
    torch.testing.assert_close(share, expected / expected.sum(), atol=0.006, rtol=0)
