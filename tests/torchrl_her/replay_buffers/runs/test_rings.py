"""Rows of each run go round and round in its own block."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_her.replay_buffers.runs.rings import Places, Rings
from torchrl_her.replay_buffers.runs.storage import Move


def move(source: tuple[int, int], to: tuple[int, int]) -> Move:
    return Move(slice(*source), slice(*to))


def test_rows_go_on_where_the_last_ones_ended() -> None:
    rings = Rings(3)
    assert rings.moves(2, begin=0, count=3, capacity=5) == [move((0, 3), (10, 13))]
    assert rings.moves(2, begin=7, count=4, capacity=5) == [move((7, 9), (13, 15)), move((9, 11), (10, 12))]
    assert rings.moves(0, begin=11, count=1, capacity=5) == [move((11, 12), (0, 1))]
    assert rings.cursors == [1, 0, 2]
    assert rings.sizes == [1, 0, 5]


@pytest.mark.parametrize(
    ("cursor", "count", "expected", "after"),
    [
        (0, 0, [], 0),
        (0, 4, [move((2, 6), (4, 8))], 0),
        (2, 5, [move((3, 4), (7, 8)), move((4, 7), (4, 7))], 3),  # at 2, 3, 0, 1, 2: the first is pushed out
        (0, 8, [move((6, 10), (4, 8))], 0),
    ],
)
def test_rows_that_do_not_fit_are_left_out_in_front(
    cursor: int, count: int, expected: list[Move], after: int
) -> None:
    """The others lie where they would if all had been written."""
    rings = Rings(2)
    rings.cursors[1] = cursor
    assert rings.moves(1, begin=2, count=count, capacity=4) == expected
    assert rings.cursors == [0, after]
    assert rings.sizes == [0, min(count, 4)]


@settings(max_examples=30, deadline=None, derandomize=True)
@given(
    counts=st.lists(st.tuples(st.integers(0, 1), st.integers(0, 9)), max_size=8), capacity=st.integers(1, 6)
)
def test_moves_and_places_agree(counts: list[tuple[int, int]], capacity: int) -> None:
    """Numbers that are moved into a storage are found where the places say, or are gone from it."""
    rings = Rings(2)
    run = torch.tensor([own for own, count in counts for _ in range(count)], dtype=torch.int64)
    places, storage, begin = Places(run, len(run), runs=2), torch.full((2 * capacity,), -1), 0
    for own, count in counts:
        for source, to in rings.moves(own, begin=begin, count=count, capacity=capacity):
            storage[to] = torch.arange(source.start, source.stop)
        places.note([own], [torch.arange(begin, begin + count)], [count])
        begin += count
    at = places.rows(rings.cursors, capacity)
    assert storage[at[at >= 0]].tolist() == (at >= 0).nonzero().flatten().tolist()
    assert sum(rings.sizes) == int((storage >= 0).sum()) == int((at >= 0).sum())
