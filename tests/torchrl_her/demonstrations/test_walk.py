"""The walk back from the goal, by hand."""

from __future__ import annotations

from typing import Any

import pytest

from torchrl_her.demonstrations import WalkBack

RULE: dict[str, Any] = {"stride": 3, "threshold": 0.5, "samples": 4}


@pytest.mark.parametrize(
    ("back", "outcomes", "expected"),
    [
        (2, "", (2, "")),
        (2, "111", (2, "111")),  # too few
        (2, "0011", (5, "")),  # half of four
        (2, "1000", (2, "1000")),
        (2, "100001", (2, "0001")),  # only the latest four count
        (2, "100011", (5, "")),
        (18, "1111", (20, "")),  # the longest demonstration
        (20, "1111", (20, "")),
    ],
)
def test_a_step_back(back: int, outcomes: str, expected: tuple[int, str]) -> None:
    walk = WalkBack([20], width=back, **RULE)
    walk.record(0, [outcome == "1" for outcome in outcomes])
    (left,) = walk.state_dict()["outcomes"]
    assert (walk.back[0], "".join("01"[outcome] for outcome in left)) == expected


def test_the_window_walks_back_as_far_as_the_longest_demonstration() -> None:
    walk = WalkBack([7], width=3, stride=2, threshold=1.0, samples=2)
    windows = [walk.window(0)]
    for _ in range(4):
        walk.record(0, [True, True])
        windows.append(walk.window(0))
    assert windows == [(1, 3), (3, 5), (5, 7), (5, 7), (5, 7)]


def test_several_outcomes_at_once_may_be_several_steps() -> None:
    walk = WalkBack([50], width=1, stride=1, threshold=1.0, samples=2)
    walk.record(0, [True] * 5)
    assert walk.back == [3]
    walk.record(0, [True])
    assert walk.back == [4]


def test_each_run_walks_by_itself_and_begins_anew_with_other_demonstrations() -> None:
    walk = WalkBack([9, 2], width=4, stride=2, threshold=0.5, samples=1)
    assert walk.back == [4, 2]
    walk.record(0, [True])
    walk.record(1, [False])
    assert walk.back == [6, 2]
    walk.restart(0, 5)
    assert walk.back == [4, 2]
    walk.record(0, [True] * 3)
    assert walk.back == [5, 2]


def test_its_state() -> None:
    walk, other = (WalkBack([9, 9], samples=4, threshold=0.5) for _ in range(2))
    walk.record(0, [True, False, True])
    walk.record(1, [True] * 5)
    other.load_state_dict(walk.state_dict())
    for own in (walk, other):
        own.record(0, [False])
        assert own.back == [6, 6]
        assert own.state_dict() == walk.state_dict()
    with pytest.raises(ValueError, match="the state must have 1 runs, got 2"):
        WalkBack([9]).load_state_dict(walk.state_dict())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"width": 0}, "width must be at least 1, got 0"),
        ({"stride": 0}, "stride must be at least 1, got 0"),
        ({"samples": -1}, "samples must be at least 1, got -1"),
        ({"threshold": 0.0}, r"threshold must be in \(0, 1\], got 0.0"),
        ({"threshold": float("nan")}, r"threshold must be in \(0, 1\], got nan"),
    ],
)
def test_what_it_refuses(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        WalkBack([9], **options)
