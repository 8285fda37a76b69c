"""Rows are put together of collected transitions and of what their copies change."""

from __future__ import annotations

import pytest
import torch
from tensordict import NestedKey, NonTensorStack, TensorDict
from torch import Tensor

from torchrl_her.replay_buffers.runs.rows import join_rows, take_rows
from torchrl_her.replay_buffers.runs.written import WrittenRows

ROWS = TensorDict(
    {
        "x": torch.tensor([10.0, 11.0, 12.0]),
        "state": torch.zeros(3),
        "goal": torch.full((3, 1), -7.0),
        "next": {"y": torch.tensor([20, 21, 22])},
    },
    [3],
)


def written(
    root: list[int], counts: list[int], last: list[int] | None = None, **changes: list[list[float]]
) -> WrittenRows:
    index = torch.tensor(root)
    own: dict[NestedKey, Tensor] = {key: torch.tensor(value) for key, value in changes.items()}
    ends = index if last is None else torch.tensor(last)
    return WrittenRows(index, ends, own, torch.zeros(len(root)), counts)


def test_the_virtual_ones_of_each_run_come_before_its_real_ones() -> None:
    """Run 0 has transitions 0 and 1, and a copy of 1; run 1 has transition 2, and two copies of it."""
    virtual = written([1, 2, 2], [1, 2], goal=[[5.0], [6.0], [7.0]])
    out = join_rows(ROWS, virtual, written([0, 1, 2], [2, 1]), exclude=["state"], virtual_key="virtual")
    assert set(out.keys(True, True)) == {"x", "goal", ("next", "y"), "virtual"}
    assert out["x"].tolist() == [11.0, 10.0, 11.0, 12.0, 12.0, 12.0]
    assert out["goal"].flatten().tolist() == [5.0, -7.0, -7.0, 6.0, 7.0, -7.0]
    assert out["next", "y"].tolist() == [21, 20, 21, 22, 22, 22]
    assert out["virtual"].tolist() == [[True], [False], [False], [True], [True], [False]]


def test_next_is_that_of_the_last_step() -> None:
    virtual = written([0], [1], [2], goal=[[5.0]])
    out = join_rows(ROWS, virtual, written([0, 1], [2], [1, 2]), exclude=[], virtual_key=None)
    assert out["x"].tolist() == [10.0, 10.0, 11.0]
    assert out["next", "y"].tolist() == [22, 21, 22]
    assert "virtual" not in out.keys()


def test_real_ones_alone() -> None:
    out = join_rows(ROWS, None, written([2, 0], [1, 1]), exclude=[], virtual_key="virtual")
    assert out["x"].tolist() == [12.0, 10.0]
    assert not out["virtual"].any()


@pytest.mark.parametrize("shape", [(), (1,), (1, 1), (2,)])
def test_entries_keep_their_shape(shape: tuple[int, ...]) -> None:
    entry = torch.arange(3.0).view(3, *[1] * len(shape)).expand(3, *shape)
    out = take_rows(TensorDict({"x": entry}, [3]), torch.tensor([2, 0, 0]))
    assert out["x"].shape == (3, *shape)
    assert out["x"].reshape(3, -1)[:, 0].tolist() == [2.0, 0.0, 0.0]


def test_entries_that_are_no_tensors_are_taken_too() -> None:
    names = NonTensorStack("a", "b", "c")
    out = take_rows(TensorDict({"name": names}, [3]), torch.tensor([2, 0]))
    assert out["name"] == ["c", "a"]


def test_rows_without_entries() -> None:
    assert take_rows(TensorDict(batch_size=[3]), torch.tensor([2, 0])).batch_size == (2,)
