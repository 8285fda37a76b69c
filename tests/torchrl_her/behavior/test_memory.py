"""The memory of achieved goals: a ring for each run."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from torchrl_her.behavior import AchievedGoals


def goals(*numbers: float) -> Tensor:
    return torch.tensor(numbers).unsqueeze(-1)


def kept(memory: AchievedGoals, run: int = 0) -> set[float]:
    """All that a run can draw."""
    counts = [200 if own == run else 0 for own in range(memory.runs)]
    return set(memory.goals(memory.draw(counts, 1, [None] * memory.runs)).flatten().tolist())


def test_each_run_keeps_its_newest() -> None:
    memory = AchievedGoals(3, runs=2)
    memory.add(goals(1, 2, 10, 20), goals(0, 0, 0, 0))
    memory.add(goals(3, 4, 30, 40), goals(0, 0, 0, 0), which=torch.tensor([True, True, False, True]))
    assert memory.sizes == [3, 3]
    assert (kept(memory, 0), kept(memory, 1)) == ({2.0, 3.0, 4.0}, {10.0, 20.0, 40.0})


def test_observations_belong_to_their_goals() -> None:
    memory = AchievedGoals(10)
    memory.add(goals(1, 2, 3), goals(10, 20, 30))
    index = memory.draw([50], 4, [None])
    assert index.shape == (50, 4)
    assert torch.equal(memory.observations(index), 10 * memory.goals(index))


def test_what_a_run_draws_does_not_depend_on_others() -> None:
    both, alone = AchievedGoals(8, runs=2), AchievedGoals(8)
    both.add(goals(1, 2, 3, 4), goals(0, 0, 0, 0))
    alone.add(goals(3, 4), goals(0, 0))
    sources = [torch.Generator().manual_seed(seed) for seed in (0, 1)]
    drawn = both.goals(both.draw([3, 2], 5, sources))
    own = alone.goals(alone.draw([2], 5, [torch.Generator().manual_seed(1)]))
    assert torch.equal(drawn[3:], own)


def test_a_cleared_run_has_none() -> None:
    memory = AchievedGoals(4, runs=2)
    memory.add(goals(1, 2, 3, 4), goals(0, 0, 0, 0))
    memory.clear(0)
    assert memory.sizes == [0, 2]
    assert kept(memory, 1) == {3.0, 4.0}


def test_it_goes_on_from_its_state() -> None:
    memory, other = AchievedGoals(3, runs=2), AchievedGoals(3, runs=2)
    memory.add(goals(1, 2, 3, 4), goals(5, 6, 7, 8))
    other.load_state_dict(memory.state_dict())
    for own in (memory, other):
        own.add(goals(11, 12, 13, 14), goals(0, 0, 0, 0))
    assert [kept(other, run) for run in (0, 1)] == [kept(memory, run) for run in (0, 1)]
    assert kept(other, 0) == {2.0, 11.0, 12.0}


def test_an_empty_state_is_one_too() -> None:
    memory = AchievedGoals(3)
    memory.load_state_dict(AchievedGoals(3).state_dict())
    assert memory.sizes == [0]


def test_another_state_is_refused() -> None:
    with pytest.raises(ValueError, match="2 runs with 3 goals each, got 1 runs with 3"):
        AchievedGoals(3, runs=2).load_state_dict(AchievedGoals(3).state_dict())


def test_bad_options() -> None:
    with pytest.raises(ValueError, match="capacity must be at least 1, got 0"):
        AchievedGoals(0)
    with pytest.raises(ValueError, match="runs must be at least 1, got 0"):
        AchievedGoals(3, runs=0)


def test_bad_goals() -> None:
    memory = AchievedGoals(1, runs=2)
    with pytest.raises(ValueError, match="number of goals must be a multiple of runs=2, got 3"):
        memory.add(goals(1, 2, 3), goals(1, 2, 3))
    with pytest.raises(ValueError, match="2 goals of each run do not fit into a memory of 1"):
        memory.add(goals(1, 2, 3, 4), goals(1, 2, 3, 4))
    with pytest.raises(ValueError, match="no goals were added yet"):
        memory.goals(torch.tensor([0]))
