"""Transitions know their run and their environment; held-back ones come first."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_her import HindsightOptions
from torchrl_her.replay_buffers.runs.batches import Batch

KEYS = HindsightOptions().transition_keys()


def make(numbers: list[list[float]], runs: int = 2, ids: list[int] | None = None) -> Batch:
    """A batch [N, T] of transitions with these numbers, with environment ids if they are given."""
    x = torch.tensor(numbers)
    data = TensorDict({"x": x}, x.shape)
    if ids is not None:
        data["env_ids"] = torch.tensor(ids).unsqueeze(-1).expand(x.shape)
    return Batch.of(data, KEYS, runs=runs)


def test_lanes_of_a_run_follow_those_of_the_run_before() -> None:
    """By places, environment 2 of run 1 is stream 2 + 1 * 4; ids 9, 9, 4, 4 are numbered as they come."""
    places = make([[0.0, 0.0], [0.0, 0.0], [0.0, 0.0], [0.0, 0.0]])
    assert places.streams().tolist() == [0, 0, 1, 1, 6, 6, 7, 7]
    assert make([[0.0, 0.0], [0.0, 0.0]], ids=[9, 4]).streams().tolist() == [0, 0, 3, 3]
    assert make([[0.0, 0.0], [0.0, 0.0]], runs=1, ids=[9, 4]).streams().tolist() == [0, 0, 1, 1]


def test_a_run_is_left_out() -> None:
    batch = make([[1.0], [2.0], [3.0], [4.0]])
    rest = batch.without_run(0)
    assert rest.rows["x"].tolist() == [3.0, 4.0]
    assert rest.ids.tolist() == [2, 3]
    assert len(rest.without_run(1)) == 0
    assert len(make([[1.0], [2.0]], runs=1).without_run(0)) == 0


@pytest.mark.parametrize("runs", [1, 2])
@pytest.mark.parametrize("number", [0, 3])
def test_a_state_brings_them_back(runs: int, number: int) -> None:
    batch = make([[1.0, 2.0], [3.0, 4.0]], runs).take(torch.arange(number))
    state = batch.state_dict()
    assert list(state) == ["held_runs", "held", "held_ids", "held_kind"]
    assert (state["held"] is None) == (number == 0)
    other = Batch.from_state(state, runs=runs)
    assert other.kind == "places in the batch"
    assert other.ids.tolist() == [0, 0, 1][:number]
    assert (None if other.run is None else other.run.tolist()) == ([0, 0, 1][:number] if runs == 2 else None)
    assert len(other.rows) == number
    if number:
        assert other.rows["x"].tolist() == [1.0, 2.0, 3.0]
        state["held"]["x"].zero_()
        assert other.rows["x"].tolist() == [1.0, 2.0, 3.0]
