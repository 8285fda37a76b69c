"""Statistics of the input in a curriculum: of what each stage shows, and forgotten with its meaning."""

from __future__ import annotations

import torch
from tensordict import TensorDict

from torchrl_her import Curriculum, CurriculumProgress, CurriculumStage, ZeroPad
from torchrl_her.curriculum import count_inputs, restart_inputs
from torchrl_her.modules import RunningNorm


def make_curriculum() -> Curriculum:
    """As throwing is learned: the goal of the first stage is what the second one sees in its place."""
    reach = CurriculumStage(
        name="reach", observation=[0, 1], achieved_goal=[0], desired_goal=[2], threshold=0.1
    )
    throw = CurriculumStage(
        name="throw", observation=[0, 1, 2, 3], achieved_goal=[2], desired_goal=[4], threshold=0.1
    )
    return Curriculum([reach, throw], 5)


def test_each_run_counts_the_inputs_that_its_stage_uses() -> None:
    curriculum = make_curriculum()
    progress = CurriculumProgress(curriculum, runs=2)
    progress.set_stage(1, 1)
    norm = RunningNorm({"input": 5}, runs=2)
    seen = torch.tensor([[1.0, 2.0, 0.0, 0.0], [3.0, 6.0, 0.0, 0.0], [5.0, 6.0, 7.0, 8.0]])
    goals = torch.tensor([[10.0], [30.0], [9.0]])
    rows = TensorDict({"observation": seen, "desired_goal": goals}, [3])
    count_inputs(norm, progress, rows, [0, 1], [2, 1])
    assert norm.moments_of("input", 0).n.tolist() == [2.0, 2.0, 2.0, 0.0, 0.0]
    assert norm.moments_of("input", 0).mean.tolist() == [2.0, 4.0, 20.0, 0.0, 0.0]
    assert norm.moments_of("input", 0).var.tolist() == [1.0, 4.0, 100.0, 1.0, 1.0]
    assert norm.moments_of("input", 1).mean.tolist() == [5.0, 6.0, 7.0, 8.0, 9.0]
    pad = ZeroPad(curriculum, progress, run=0)
    padded = norm.normalize("input", torch.cat((pad(rows[:2])["input"], torch.zeros(2, 5))))
    assert padded[:2].tolist() == [[-1.0, -1.0, -1.0, 0.0, 0.0], [1.0, 1.0, 1.0, 0.0, 0.0]]


def test_zeros_behind_a_narrower_goal_are_not_counted() -> None:
    near = CurriculumStage(name="near", observation=[0], achieved_goal=[0], desired_goal=[1], threshold=1.0)
    far = CurriculumStage(
        name="far", observation=[0, 1], achieved_goal=[0, 1], desired_goal=[2, 3], threshold=1.0
    )
    progress, norm = CurriculumProgress(Curriculum([near, far], 4)), RunningNorm({"input": 4})
    rows = TensorDict({"observation": torch.ones(2, 2), "desired_goal": torch.ones(2, 2)}, [2])
    count_inputs(norm, progress, rows, [0], [2])
    assert norm.moments_of("input").n.tolist() == [2.0, 2.0, 0.0, 0.0]


def test_a_new_stage_forgets_what_means_something_else() -> None:
    curriculum, norm = make_curriculum(), RunningNorm({"input": 5}, runs=2)
    for run in range(2):
        norm.count("input", torch.tensor([[1.0, 2.0, 3.0, 4.0, 5.0]]), run=run)
    restart_inputs(norm, *curriculum.stages, run=1)
    assert norm.moments_of("input", 0).n.tolist() == [1.0] * 5
    assert norm.moments_of("input", 1).n.tolist() == [1.0, 1.0, 1.0, 0.0, 0.0]
    assert norm.moments_of("input", 1).mean.tolist() == [1.0, 2.0, 3.0, 0.0, 0.0]
    restart_inputs(norm, *reversed(curriculum.stages), run=0)
    assert norm.moments_of("input", 0).n.tolist() == [1.0, 1.0, 1.0, 0.0, 0.0]
