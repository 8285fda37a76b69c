"""Weights of rare or new goals, and IBS without a grid: each trains, resumes and stands alone."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch

from torchrl_her import Instructiveness
from torchrl_her.goals import KernelInstructiveness, NetworkNovelty, RareGoals
from torchrl_her.replay_buffers import rows_of_run
from torchrl_her_envs import make_env
from torchrl_her_recipes import Components, Recipe, build, resume, run
from torchrl_her_recipes.components.envs import TaskEnvs
from torchrl_her_recipes.components.goals.space import KernelSpace, goal_space
from torchrl_her_recipes.config.choices.weights import IBS

from ...small import assert_same_runs, small, stop_after

CASES: dict[str, dict[str, Any]] = {
    "rare": {"algo": "filtered_her_rare"},
    "rnd": {"algo": "filtered_her_rnd"},
    "stages, rare": {"algo": "cher_rare", "task": "hand_v1", "success_threshold": 0.01, "window": 4},
    "stages, rnd": {"algo": "cher_rnd", "task": "hand_v1", "success_threshold": 0.01, "window": 4},
    "kernel": {"algo": "filtered_her_ibs", "estimator": "kernel"},
    "many numbers, rare": {"algo": "filtered_her_rare", "task": "bit_flip"},
    "many numbers, IBS": {"algo": "her_ibs", "task": "bit_flip"},
}
KINDS = {
    "rare": RareGoals,
    "rnd": NetworkNovelty,
    "kernel": KernelInstructiveness,
    "IBS": KernelInstructiveness,
}


def recipe(case: str, **options: Any) -> Recipe:
    return small(**{**CASES[case], "frames_per_update": 50.0, **options})


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], tuple[Components, Path]]:
    """Trains two runs of each case once."""

    @cache
    def train(case: str) -> tuple[Components, Path]:
        components, folder = build(recipe(case, num_runs=2, seed=5)), tmp_path_factory.mktemp("whole")
        run(components, folder, progress=False)
        return components, folder

    return train


@pytest.mark.parametrize("case", CASES)
def test_runs_side_by_side_are_the_runs_that_they_would_be_alone(
    case: str, whole: Callable[[str], tuple[Components, Path]]
) -> None:
    together, _ = whole(case)
    alone = build(recipe(case, seed=6))
    run(alone, progress=False)
    weights = together.buffer.writer.goal_weights
    assert [type(own) for own in weights] == [KINDS[case.split()[-1]]] * 2
    rows, own = rows_of_run(together.buffer, 1), rows_of_run(alone.buffer)
    assert bool(own["virtual"].any())
    torch.testing.assert_close(rows["desired_goal"], own["desired_goal"], rtol=1e-4, atol=1e-5)
    goals = own["desired_goal"][::7]
    torch.testing.assert_close(weights[1](goals), alone.buffer.writer.weights(goals), rtol=1e-2, atol=1e-4)
    assert not torch.allclose(weights[0](goals), weights[1](goals))


@pytest.mark.parametrize("case", CASES)
def test_a_run_that_was_stopped_goes_on_as_if_it_had_not_been(
    case: str, whole: Callable[[str], tuple[Components, Path]], tmp_path: Path
) -> None:
    stopped = build(recipe(case, num_runs=2, seed=5))
    stop_after(stopped, 8)
    run(stopped, tmp_path, progress=False)
    resume(tmp_path, progress=False)
    assert_same_runs(whole(case)[1], tmp_path)


def test_only_runs_with_ibs_tell_a_divergence(tmp_path: Path) -> None:
    for algo, told in (("filtered_her_rare", False), ("filtered_her_ibs", True)):
        estimator = {"estimator": "kernel"} if told else {}
        rows = run(build(small(algo=algo, **estimator)), tmp_path / algo, progress=False).rows
        assert all(("kl" in row) == told for row in rows)
        assert not told or all(0.0 < row["kl"] < 100.0 for row in rows)
        assert not (tmp_path / algo / "goal_map.npz").exists()


def test_the_options_arrive() -> None:
    rare = build(small(algo="filtered_her_rare", sharpness=0.5, memory=77)).buffer.writer.weights
    assert (rare.estimator, rare.sharpness, rare.memory) == ("kernel", 0.5, 77)
    assert (
        build(small(algo="filtered_her_rare", task="bit_flip")).buffer.writer.weights.estimator == "neighbors"
    )
    new = build(small(algo="filtered_her_rnd", sharpness=0.5, num_runs=2, seed=3)).buffer.writer.goal_weights
    assert [(own.seed, own.sharpness) for own in new] == [(3, 0.5), (4, 0.5)]
    ibs = build(small(algo="her_ibs_sequential", estimator="kernel", sigma=0.1, start_factor=2.0, decay=0.5))
    weights = ibs.buffer.writer.weights
    assert (weights.subtract, weights.start_factor, weights.decay) == (False, 2.0, 0.5)
    assert weights.final_sigma == pytest.approx(0.1 * 2.0)  # the screen is 2 wide
    assert ibs.trainer().schedules[1:] == [weights]


def test_the_kernel_s_sigma_is_the_grid_s_and_grows_with_the_root_of_the_numbers() -> None:
    throwing = TaskEnvs.of(small()), make_env("hand_v0"), 8
    space = goal_space(IBS(estimator="kernel"), *throwing)
    assert isinstance(space, KernelSpace)
    grid = goal_space(IBS(), *throwing)
    assert space.sigma == pytest.approx(grid.sigma) == pytest.approx(0.4)
    assert space.goals.shape[1] == 2
    flipping = small(**{"task": "bit_flip", "task.options.bits": 12})
    bits = TaskEnvs.of(flipping), make_env("bit_flip", bits=12), 8
    many = goal_space(IBS(), *bits)
    assert isinstance(many, KernelSpace)
    assert many.sigma == pytest.approx(0.2 * math.sqrt(12 / 3))
    given = goal_space(IBS(sigma=0.3), *bits)
    assert given.sigma == pytest.approx(0.3)


def test_a_grid_over_many_numbers_is_refused_by_name() -> None:
    message = "estimator=grid needs goals of at most 3 numbers, and those of bit_flip have 15; choose"
    with pytest.raises(ValueError, match=message):
        build(small(task="bit_flip", algo="her_ibs", estimator="grid"))
    weights = build(small(task="treasure_hunt", algo="her_ibs")).buffer.writer.weights
    assert isinstance(weights, Instructiveness)  # one number


def test_a_fetch_task_trains_with_a_curriculum_and_ibs_by_kernels() -> None:
    pytest.importorskip("gymnasium_robotics")
    recipe = small(
        algo="cher_ibs",
        task="gym:FetchPickAndPlace-v4",
        estimator="kernel",
        num_envs=4,
        epochs=1,
        epoch_frames=400,
        episodes=4,
        goal_sources={"future": 3, "actual": 1},
    )
    components = build(recipe)
    weights = components.buffer.writer.weights
    assert isinstance(weights, KernelInstructiveness)
    assert weights.is_uniform  # the first stage reaches for the object
    rows = run(components, progress=False).rows
    assert rows[-1]["rows_virtual"] == weights.written > 0
    assert math.isnan(rows[-1]["kl"])  # until the last stage
