"""Episodes are found whole, whatever order their rows arrive in."""

from __future__ import annotations

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_her.replay_buffers import find_episodes
from torchrl_her.replay_buffers.episodes import time_order
from torchrl_her.replay_buffers.runs.pieces import split_runs


def test_episodes_of_different_lengths_are_padded_with_their_last_row() -> None:
    streams = torch.zeros(5, dtype=torch.int64)
    done = torch.tensor([False, False, True, False, True])
    episodes, left = find_episodes(streams, done)
    assert episodes.rows.tolist() == [[0, 1, 2], [3, 4, 4]]
    assert episodes.lengths.tolist() == [3, 2]
    assert episodes.inside.tolist() == [[True, True, True], [True, True, False]]
    assert left.tolist() == []


def test_interleaved_lanes_are_told_apart() -> None:
    streams = torch.tensor([0, 1, 2, 0, 1, 2, 0, 1, 2])
    done = torch.tensor([False, False, True, False, True, False, True, False, False])
    episodes, left = find_episodes(streams, done)
    assert [rows[:n] for rows, n in zip(episodes.rows.tolist(), episodes.lengths.tolist(), strict=True)] == [
        [0, 3, 6],
        [1, 4],
        [2],
    ]
    assert left.tolist() == [5, 7, 8]


def test_no_rows_at_all() -> None:
    nothing = torch.empty(0, dtype=torch.int64)
    episodes, left = find_episodes(nothing, nothing.bool())
    assert len(episodes.lengths) == len(left) == 0


def test_an_order_that_is_known_is_used() -> None:
    streams, end = torch.tensor([1, 0, 1, 0]), torch.tensor([False, True, False, True])
    episodes, left = find_episodes(streams, end, time_order(streams))
    assert episodes.rows.tolist() == [[1], [3]]
    assert left.tolist() == [0, 2]


def test_pieces_of_one_run_or_several_keep_the_order() -> None:
    episodes, _ = find_episodes(torch.arange(5), torch.ones(5, dtype=torch.bool))
    for run in (None, torch.tensor([2] * 5)):
        pieces = split_runs(episodes, run, [0, 0, 0], each=2, together=9)
        rows = [(piece.runs, piece.episodes.rows.flatten().tolist()) for piece in pieces]
        number = 0 if run is None else 2
        assert rows == [([number], part) for part in ([0, 1], [2, 3], [4])]


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 3), st.booleans()), min_size=1, max_size=40))
def test_every_row_is_in_one_episode_or_left(rows: list[tuple[int, bool]]) -> None:
    streams, done = torch.tensor([stream for stream, _ in rows]), torch.tensor([end for _, end in rows])
    episodes, left = find_episodes(streams, done)
    inside = episodes.rows[episodes.inside].tolist()
    assert sorted(inside + left.tolist()) == list(range(len(rows)))
    for row, length in zip(episodes.rows, episodes.lengths, strict=True):
        own = row[:length]
        assert len(set(streams[own].tolist())) == 1
        assert own.tolist() == sorted(own.tolist())
        assert done[own].tolist() == [False] * (int(length) - 1) + [True]
