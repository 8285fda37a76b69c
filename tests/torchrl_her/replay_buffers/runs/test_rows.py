"""Rows are taken with all their entries, of any shape and kind."""

from __future__ import annotations

import pytest
import torch
from tensordict import NonTensorStack, TensorDict

from torchrl_her.replay_buffers.runs.rows import take_rows


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
