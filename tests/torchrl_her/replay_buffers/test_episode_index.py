"""Where the episodes of a ring buffer lie."""

from __future__ import annotations

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_her.replay_buffers.sample_unit import index_episodes

# Where episodes lie


def episodes_of(done: list[int], ids: list[int] | None = None, oldest: int = 0) -> list[list[int]]:
    index = index_episodes(
        torch.tensor(done).bool(), None if ids is None else torch.tensor(ids), oldest=oldest
    )
    bounds = zip(index.first.tolist(), index.first[1:].tolist(), strict=False)
    return [index.row(torch.arange(*bound)).tolist() for bound in bounds]


def test_episodes_end_where_they_are_done() -> None:
    assert episodes_of([0, 0, 1, 1, 0]) == [[0, 1, 2], [3], [4]]


def test_an_episode_goes_on_over_the_end_of_the_ring() -> None:
    assert episodes_of([0, 1, 0, 1, 0], oldest=2) == [[2, 3], [4, 0, 1]]


def test_without_ids_the_cursor_alone_keeps_the_newest_from_the_oldest() -> None:
    assert episodes_of([0, 0, 0, 1, 1], oldest=2) == [[2, 3], [4], [0, 1]]


def test_lanes_are_kept_apart_though_they_use_the_same_ids() -> None:
    done = torch.tensor([[0, 0], [1, 0], [0, 0]]).bool()
    index = index_episodes(done, torch.tensor([[0, 0], [0, 0], [1, 0]]), oldest=1)
    # Rows are slot * 2 + stream; slot 1 is the oldest. In stream 0 the row of slot 1 is done.
    bounds = zip(index.first.tolist(), index.first[1:].tolist(), strict=False)
    found = [index.row(torch.arange(*bound)).tolist() for bound in bounds]
    assert found == [[2], [4], [0], [3, 5, 1]]


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 3), st.booleans()), min_size=1, max_size=30), st.integers(0, 29))
def test_places_agree_with_a_walk_through_the_rows(rows: list[tuple[int, bool]], cursor: int) -> None:
    oldest = cursor % len(rows)
    ids, done = ([row[i] for row in rows] for i in range(2))
    walked: list[list[int]] = []
    going: dict[int, list[int]] = {}
    for slot in [*range(oldest, len(rows)), *range(oldest)]:
        episode = going.get(ids[slot])
        if episode is None:
            walked.append(episode := [])
        episode.append(slot)
        going[ids[slot]] = episode
        if done[slot]:
            del going[ids[slot]]
    assert sorted(episodes_of([int(one) for one in done], ids, oldest)) == sorted(walked)
    index = index_episodes(torch.tensor(done), torch.tensor(ids), oldest=oldest)
    every = torch.arange(len(rows))
    assert torch.equal(index.row(index.place(every)), every)


def test_the_newest_rows_and_episodes() -> None:
    # Slots 0 and 1 are the newest; trajectory 6 began before 5 did, and 5 ended before 6.
    index = index_episodes(torch.tensor([0, 0, 0, 1, 1]).bool(), torch.tensor([7, 7, 6, 5, 6]), oldest=2)
    assert index.newest(3).tolist() == [4, 0, 1]
    assert index.newest(9).tolist() == [2, 3, 4, 0, 1]
    assert index.newest_episodes(2).tolist() == [2, 0]
    assert index.newest_episodes(9).tolist() == [3, 2, 0]


def test_the_newest_rows_of_several_environments() -> None:
    done = torch.tensor([[0, 1], [1, 0], [0, 0]]).bool()  # three slots of two environments, slot 1 is oldest
    index = index_episodes(done, oldest=1)
    assert index.newest(3).tolist() == [5, 0, 1]
    # Environment 0: row 2 alone, then 4 and 0. Environment 1: rows 3, 5 and 1.
    assert index.newest_episodes(2).tolist() == [4, 3]
    assert index.newest_episodes(1).tolist() == [3]
