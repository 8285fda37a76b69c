"""The audit itself: it finds each of the faults that it is there for."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDictBase

from .audit import Log, Rows, check_slices, check_stored, check_written
from .collect import SOURCES
from .parts import EPISODES, FLAT, WRITER, K, make_buffer

BATCHES = SOURCES["`Collector`, batched environment"].collect(env_ids=False)
LOG = Log(BATCHES)


def stored(part: str) -> tuple[TensorDictBase, int]:
    """What a writer stored of BATCHES, and how many rows it held back."""
    buffer = make_buffer(part)
    for batch in BATCHES:
        buffer.extend(batch)
    return buffer.storage[:].clone(), buffer.writer.held_back


def _other_goal(rows: TensorDictBase, virtual: int) -> None:
    goal = rows["desired_goal"][virtual] + torch.tensor([0.0, 1.0, 0.0, 0.0])
    rows["desired_goal"][virtual] = rows["next", "desired_goal"][virtual] = goal


def _past_goal(rows: TensorDictBase, virtual: int) -> None:
    goal = rows["observation"][virtual].clone()
    rows["desired_goal"][virtual] = rows["next", "desired_goal"][virtual] = goal


def _flip(*key: str) -> Callable[[TensorDictBase, int], None]:
    def change(rows: TensorDictBase, virtual: int) -> None:
        rows[key][virtual] = ~rows[key][virtual]

    return change


def _add(*key: str) -> Callable[[TensorDictBase, int], None]:
    def change(rows: TensorDictBase, virtual: int) -> None:
        rows[key][virtual] += 1

    return change


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        (_other_goal, "a goal crossed episodes"),
        (_past_goal, "a goal was achieved in the past"),
        (_add("desired_goal"), "root and next want different goals"),
        (_add("next", "reward"), "a reward does not fit the goal"),
        (_add("action"), "is another row's"),
        (_add("next", "observation"), "is another row's"),
        (_flip("next", "terminated"), "terminated does not fit the goal"),
        (_flip("next", "truncated"), "truncated is not the real row's"),
        (_flip("next", "done"), "done is not terminated or truncated"),
        (_flip("virtual"), "the mark of virtual rows is wrong"),
    ],
)
def test_a_wrong_row_is_found(fault: Callable[[TensorDictBase, int], None], message: str) -> None:
    rows, _ = stored(WRITER)
    right = Rows(rows, LOG)
    late = right.virtual & (rows["observation"][:, 3] >= 2) & ~rows["next", "done"].view(-1)
    fault(rows, int(late.nonzero()[0]))
    with pytest.raises(AssertionError, match=message):
        Rows(rows, LOG)


@pytest.mark.parametrize(("part", "per"), [(WRITER, "transition"), (EPISODES, "episode")])
def test_lost_and_doubled_rows_are_found(part: str, per: str) -> None:
    rows, held_back = stored(part)
    real, virtual = (
        (~rows["virtual"].view(-1)).nonzero().view(-1),
        rows["virtual"].view(-1).nonzero().view(-1),
    )

    def check(index: torch.Tensor) -> None:
        check_written(Rows(rows[index], LOG), LOG, held_back=held_back, k=K, per=per)

    check(torch.cat((real, virtual)))
    with pytest.raises(AssertionError, match="rows were lost"):
        check(torch.cat((real[1:], virtual)))
    with pytest.raises(AssertionError, match="stored twice"):
        check(torch.cat((real, real[:1], virtual)))
    with pytest.raises(AssertionError, match=r"copies than k|no sequence|without virtual copies|begin with"):
        check(torch.cat((real, virtual[1:])))


def test_a_plain_buffer_that_lost_a_row_is_found() -> None:
    buffer = make_buffer(FLAT)
    for batch in BATCHES:
        buffer.extend(batch.reshape(-1))
    check_stored(buffer.storage[:], LOG)
    with pytest.raises(AssertionError, match="119 rows are stored of 120"):
        check_stored(buffer.storage[1:], LOG)


def test_slices_that_are_none_are_found() -> None:
    rows = LOG.rows[:6].clone()  # steps 0 to 3, and two of the next episode
    rows["virtual"] = torch.zeros(6, 1, dtype=torch.bool)
    check_slices(Rows(rows[:4], LOG), 2)
    with pytest.raises(AssertionError, match="no sequence"):
        check_slices(Rows(rows, LOG), 3)
    rows["virtual"][3] = True
    goal = rows["next", "achieved_goal"][3]
    rows["desired_goal"][3] = rows["next", "desired_goal"][3] = goal
    rows["next", "reward"][3], rows["next", "terminated"][3], rows["next", "done"][3] = 0.0, True, True
    with pytest.raises(AssertionError, match="several goals"):
        check_slices(Rows(rows[2:4], LOG), 2)
