"""What is forgotten and what is kept when a stage begins."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torchrl.data import LazyTensorStorage, ReplayBuffer, TensorDictReplayBuffer

from torchrl_her import (
    CurriculumStage,
    DecayingEpsilon,
    GoalGrid,
    GoalReward,
    HERWriter,
    Instructiveness,
    enter_stage,
)
from torchrl_her.curriculum import set_stage_goals

from ..her_data import make_batch


def make_stage(threshold: float, *, instructive: bool = True) -> CurriculumStage:
    return CurriculumStage(
        name="one",
        observation=[0],
        achieved_goal=[0],
        desired_goal=[1],
        threshold=threshold,
        instructive=instructive,
    )


def uniform(_sigma: float) -> Tensor:
    return torch.full((4,), 0.25)


def make_buffer() -> TensorDictReplayBuffer:
    weights = Instructiveness(GoalGrid((-1.0, -1.0), (10.0, 1.0), (4, 1)), uniform, sigma=0.5)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(100), writer=HERWriter(GoalReward(0.5), k=2, weights=weights), batch_size=4
    )
    buffer.extend(make_batch([[3]]))
    weights.step()
    return buffer


def test_transitions_and_q_are_forgotten_and_sigma_and_epsilon_start_anew() -> None:
    buffer, exploration = make_buffer(), DecayingEpsilon(-torch.ones(1), torch.ones(1), decay=0.5)
    exploration.step()
    weights = buffer.writer.weights
    assert len(buffer) == 9
    assert int(weights.counts.sum()) == 6
    assert weights.sigma < 1.5
    enter_stage(buffer, make_stage(0.2), exploration)
    assert len(buffer) == 0
    assert int(weights.counts.sum()) == 0
    assert weights.sigma == 1.5
    assert buffer.writer.reward_of(0).threshold == 0.2
    assert (buffer.writer.k, weights.is_uniform) == (2, False)
    assert exploration.epsilon.tolist() == [1.0]


def test_epsilon_of_one_run_starts_where_it_is_told() -> None:
    generators = [torch.Generator(), torch.Generator()]
    exploration = DecayingEpsilon(-torch.ones(1), torch.ones(1), decay=0.5, generators=generators)
    exploration.step()
    enter_stage(make_buffer(), make_stage(0.2), exploration, epsilon=0.8, run=1)
    assert exploration.epsilon.tolist() == [0.5, 0.8]


def test_a_stage_says_whether_goals_are_weighed() -> None:
    writer = make_buffer().writer
    set_stage_goals(writer, make_stage(0.3, instructive=False))
    assert writer.weights.is_uniform
    set_stage_goals(writer, make_stage(0.3))
    assert not writer.weights.is_uniform
    assert writer.reward_of(0).threshold == 0.3


def test_a_buffer_without_hindsight_is_refused() -> None:
    buffer = ReplayBuffer(storage=LazyTensorStorage(10))
    with pytest.raises(TypeError, match="needs a buffer with a HERWriter, got a RoundRobinWriter"):
        enter_stage(buffer, make_stage(0.3))
