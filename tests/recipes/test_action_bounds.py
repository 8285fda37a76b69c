"""A task with actions in units of its own, from training to its files."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from torchrl_her_recipes import build, export_policy, load_policy, play, record_demonstrations, run
from torchrl_her_recipes.components.envs import TaskEnvs

from .small import small

TASK = "tests.envs.common.own_point:make_levers"
LOW, HIGH = torch.tensor([0.0, -30.0]), torch.tensor([10.0, 50.0])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("levers")
    recipe = small(task=TASK, epochs=3, frames_per_update=4, episodes=30, seed=1)
    assert run(build(recipe), folder / "run", progress=False).rows[-1]["success"] > 0.9
    return folder


def test_an_exported_policy_acts_in_the_units_of_the_task(folder: Path) -> None:
    file = folder / "mine.safetensors"
    info = export_policy(folder / "run", file).info
    assert (info.low, info.high) == (tuple(LOW.tolist()), tuple(HIGH.tolist()))
    assert info.success > 0.9
    env = TaskEnvs.of(small(task=TASK)).make(20, [3], scaled=False)
    action = env.rollout(8, load_policy(file), break_when_any_done=False)["action"]
    assert (action.amin((0, 1)) < LOW + 3).all()
    assert (action.amax((0, 1)) > HIGH - 3).all()


def test_it_is_filmed(folder: Path) -> None:
    ((achieved, goals),) = play(folder / "run", out=folder / "film.gif", goals=3)
    assert 2 <= achieved <= goals == 3


def test_demonstrations_are_in_the_units_of_the_task_and_learned_from_in_those_of_the_learner(
    folder: Path,
) -> None:
    export_policy(folder / "run", folder / "teacher.safetensors")
    file = folder / "demos.pt"
    shown = record_demonstrations(
        TASK, file, episodes=5, policy=folder / "teacher.safetensors"
    ).demonstrations
    assert (shown.rows["action"] > 1.5).any()
    options = {"demonstrations.file": str(file), "demonstrations.episodes": 5}
    components = build(small(task=TASK, epochs=1, **options))
    seen = components.demonstrations.shown(0).rows["action"]
    torch.testing.assert_close(LOW + (seen + 1) / 2 * (HIGH - LOW), shown.rows["action"], atol=1e-4, rtol=0)
    run(components, progress=False)
