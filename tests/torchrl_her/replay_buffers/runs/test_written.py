"""Real and virtual transitions of several runs at once, and how many each run has."""

from __future__ import annotations

import pytest
import torch
from tensordict import NonTensorStack, TensorDict

from torchrl_her import GoalReward, HindsightOptions
from torchrl_her.replay_buffers.episodes import Episodes
from torchrl_her.replay_buffers.runs.pieces import Chunk, Piece
from torchrl_her.replay_buffers.runs.written import real_rows, take_rows, virtual_rows

from ...her_data import make_batch

# Environment 0 plays an episode of 2 steps and environment 1 one of 3 (and one step of another).
# They are runs 3 and 5 of a writer.
ROWS: TensorDict = make_batch([[2, 9], [3, 9]], steps=4).reshape(-1)
RUN = torch.tensor([3, 3, 3, 3, 5, 5, 5, 5])
PIECE = Piece(
    [3, 5],
    Episodes(torch.tensor([[0, 1, 1], [4, 5, 6]]), torch.tensor([2, 3])),
    torch.tensor([0, 1]),
)


def chunk(**options: object) -> Chunk:
    own = HindsightOptions().changed(options)
    return Chunk(ROWS, RUN, PIECE, GoalReward(0.5), own, own.transition_keys())


def test_whole_episodes_have_ids() -> None:
    """Two copies of the second episode: one up to its second state, one up to its end."""
    own = chunk(per="episode")
    source, goals = torch.tensor([4, 4]), ROWS["next", "achieved_goal"][[5, 6]]
    virtual = virtual_rows(own, source, goals, first_id=10)
    assert virtual.root.tolist() == [4, 5, 4, 5, 6]
    assert virtual.counts == [0, 5]
    assert virtual.changes[own.keys.trajectory].tolist() == [10, 10, 11, 11, 11]
    real = real_rows(own, first_id=12)
    assert real.changes[own.keys.trajectory].tolist() == [12, 12, 13, 13, 13]
    assert real.counts == [2, 3]


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
