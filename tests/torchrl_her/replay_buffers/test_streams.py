"""Streams: what is looked at again when the next batch comes."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from torchrl_her import GoalReward, HERWriter
from torchrl_her.replay_buffers import streams

from ..her_data import make_batch


@pytest.mark.parametrize("flat", [True, False], ids=["flat, with ids", "by place, without ids"])
def test_rows_that_are_held_back_are_compared_once(flat: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    compared: list[int] = []
    jumps = streams._jumps

    def count(rows: TensorDict, keys: object, last: Tensor, new: Tensor, where: Tensor) -> Tensor:
        compared.append(int(where.count_nonzero()))
        return jumps(rows, keys, last, new, where)

    monkeypatch.setattr(streams, "_jumps", count)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(1_000), writer=HERWriter(GoalReward(0.5)))
    whole = make_batch([[20], [20]])
    for begin in range(0, 20, 5):
        part = whole[:, begin : begin + 5]
        buffer.extend(part.reshape(-1) if flat else part.exclude("collector"))
    assert compared == [8, 10, 10, 10]  # each row with the one before it
    assert buffer.writer.counts.real == 40


def test_an_environment_that_was_reset_meanwhile_is_noticed_in_the_middle_of_a_batch() -> None:
    writer = HERWriter(GoalReward(0.5), k=0)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(1_000), writer=writer)
    whole = make_batch([[6, 6]]).reshape(-1)
    whole["next", "done"].fill_(False)
    whole["next", "truncated"].fill_(False)
    whole["collector", "traj_ids"].fill_(1)  # one id for both episodes
    buffer.extend(whole[:3])
    buffer.extend(whole[3:9])
    assert (writer.counts.real, writer.held_back) == (6, 3)
    assert torch.equal(buffer[:]["observation"], whole["observation"][:6])
