"""Draws the virtual goals of finished runs from their files."""

from __future__ import annotations

from pathlib import Path

from torchrl_her_envs.common.goal_env import goal_env
from torchrl_her_recipes.components.envs import TaskEnvs
from torchrl_her_recipes.runs.plots import plot_goals
from torchrl_her_recipes.studies.seed_batches import Batches


def plot_virtual_goals(folder: str | Path, out: str | Path) -> None:
    """Draws a heat map of a run's virtual goals beside a heat map of their target q*.

    Args:
        folder: folder of a run, or of a combination of a study.
        out: path of the figure.

    Raises:
        ValueError: the folder has no run, the run has no map of goals, or its task names a module that must
            not be imported.
    """
    runs = Batches(Path(folder))
    if not runs.homes:
        raise ValueError(f"{folder} is no folder of a run")
    recipe = runs.homes[0].recipe()
    goals = runs.goal_map()
    if goals is None:
        raise ValueError(f"{folder} has no map of goals: {_missing(runs, recipe.task.name)}")
    task, algo = recipe.task.name, recipe.hindsight.algo
    plot_goals(
        goals, goal_env(TaskEnvs.of(recipe).make(1, [0])), Path(out), title=f"virtual goals: {task}, {algo}"
    )


def _missing(runs: Batches, task: str) -> str:
    """Returns the reason why runs have no map of goals, for a message."""
    rows = runs.rows()
    if not rows or not rows[-1].get("rows_virtual"):
        return "its runs have written no virtual goals"
    if not runs.is_done:
        return "it is written when a run ends"
    return f"virtual goals are counted over the box that a task's goal_box() returns, and {task} has none"
