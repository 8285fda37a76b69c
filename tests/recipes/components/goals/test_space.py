"""Runs that prefer instructive goals, and what every run tells of its virtual goals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from PIL import Image

from torchrl_her import Instructiveness
from torchrl_her.goals import GoalHistogram
from torchrl_her_envs import TASKS, make_env
from torchrl_her_recipes import build, run
from torchrl_her_recipes.cli import main
from torchrl_her_recipes.components.envs import TaskEnvs
from torchrl_her_recipes.components.goals.space import GoalSpace, goal_space
from torchrl_her_recipes.config.choices.weights import Equal
from torchrl_her_recipes.runs.goal_map import GoalMap

from ...small import Refused, small


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "run"
    run(build(small(algo="filtered_her_ibs", num_runs=2, epochs=3)), folder, progress=False)
    return folder


@pytest.mark.parametrize("task", TASKS)
def test_every_task_has_a_target(task: str) -> None:
    space = goal_space(Equal(), TaskEnvs.of(small(task=task)), make_env(task), 8)
    assert isinstance(space, GoalSpace)
    target = space.target
    assert target.shape == (400,)
    assert float(target.sum()) == pytest.approx(1.0)
    greatest = int(target.argmax())
    goals = make_env(task).goal_distribution
    center = torch.tensor([greatest // 20, greatest % 20]) * 0.1 - 0.95  # of the cell with most of it
    assert (center >= goals.low - 0.1).all()
    assert (center <= goals.high + 0.1).all()


@pytest.mark.parametrize(
    ("algo", "kind", "subtract"),
    [
        ("her", GoalHistogram, None),
        ("her_ibs", Instructiveness, True),
        ("her_ibs_sequential", Instructiveness, False),
    ],
)
def test_each_algorithm_has_its_weights(algo: str, kind: type, subtract: bool | None) -> None:
    weights = build(small(algo=algo)).buffer.writer.weights
    assert type(weights) is kind
    assert getattr(weights, "subtract", None) is subtract


def test_sigma_is_a_share_of_the_screen_and_smaller_beside_the_wall() -> None:
    for task, options, sigma in (
        ("hand_v0", {}, 0.4),
        ("hand_wall_v0", {}, 0.2),
        ("hand_wall_v0", {"sigma": 0.3}, 0.6),
    ):
        weights = build(small(task=task, algo="her_ibs", **options)).buffer.writer.weights
        assert isinstance(weights, Instructiveness)
        assert weights.final_sigma == pytest.approx(sigma)
        assert weights.sigma == pytest.approx(3 * sigma)


@pytest.mark.parametrize("task", ["hand_reach", "robot_reach"])
def test_goals_around_the_start_states_are_refused_by_name(task: str) -> None:
    with pytest.raises(ValueError, match=f"IBS must not be used on {task}"):
        build(small(task=task, algo="her_ibs"))
    build(small(task=task, algo="her"))  # counting them is fine


def test_sigma_shrinks_each_epoch_and_divergence_is_logged(finished: Path) -> None:
    rows = pd.read_csv(finished / "metrics.csv")
    assert rows["kl"].between(0.0, 20.0).all()
    components = build(small(algo="her_ibs"))
    run(components, progress=False)
    weights = components.buffer.writer.weights
    assert weights.sigma == pytest.approx(3 * 0.4 * 0.9)  # two epochs, each a root of 0.9


def test_without_hindsight_there_is_nothing_to_tell(tmp_path: Path, refused: Refused) -> None:
    run(build(small(algo="no_hindsight", epochs=1, pictures=True)), tmp_path / "run", progress=False)
    assert "kl" not in pd.read_csv(tmp_path / "run" / "metrics.csv").columns
    assert (tmp_path / "run" / "curves.png").exists()
    assert not (tmp_path / "run" / "virtual_goals.png").exists()
    said = "has no map of goals: its runs have written no virtual goals\n"
    assert refused("plot", str(tmp_path / "run")).endswith(said)


def test_the_map_holds_all_virtual_goals_of_each_run(finished: Path) -> None:
    goals = GoalMap.load(finished / "goal_map.npz")
    rows = pd.read_csv(finished / "metrics.csv")
    assert goals.counts.shape == (2, 20, 20)
    assert goals.counts.sum((1, 2)).tolist() == rows[rows["epoch"] == 3]["rows_virtual"].tolist()
    assert goals.share.sum() == pytest.approx(1.0)
    assert np.allclose(goals.target.sum(), 1.0)


def test_plot_goals_draws_them_again(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "goals.png"
    assert main(["plot", str(finished), "--out", str(out)]) == 0
    assert capsys.readouterr().out.strip() == str(out)
    with Image.open(out) as picture:
        assert picture.size[0] > picture.size[1] > 300


def test_a_run_without_a_map_is_named(tmp_path: Path, refused: Refused) -> None:
    run(build(small(task="chain", epochs=1)), tmp_path, progress=False)
    said = "over the box that a task's goal_box() returns, and chain has none"
    assert said in refused("plot", str(tmp_path))
    (tmp_path / "policy.safetensors").unlink()
    said = "has no map of goals: it is written when a run ends\n"
    assert refused("plot", str(tmp_path)).endswith(said)
