"""Pictures of runs that were made before: their virtual goals, their values, the times that they took."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from torchrl_her_envs.common.goal_env import goal_env
from torchrl_her_recipes.components.envs import make_task_envs
from torchrl_her_recipes.config.imports import permit_task
from torchrl_her_recipes.runs.plots import plot_goals
from torchrl_her_recipes.studies.chain_times import plot_times
from torchrl_her_recipes.studies.seed_batches import Batches
from torchrl_her_recipes.studies.toy_plots import plot_values

Kind = Literal["goals", "values", "times"]


def plot_runs(what: Kind, folders: Sequence[Path], out: Path, *, allow_import: bool = False) -> None:
    """Draws a picture of runs.

    Args:
        what: virtual goals beside q*, values in a toy environment, or times until chains were solved.
        folders: of runs, or of the batches of a study's combination.
        out: the picture.
        allow_import: whether the module that the runs' task may name may be imported.

    Raises:
        ValueError: a folder without a run, runs that this picture is not for, or a task that names a module
            that must not be imported.
    """
    runs = [Batches(folder) for folder in folders]
    for own in runs:
        if not own.homes:
            raise ValueError(f"{own.path} is no folder of a run")
        if allow_import:
            permit_task(own.homes[0].recipe().task.name)
    if what == "values":
        plot_values(runs, out)
    elif what == "times":
        plot_times([(own.homes[0].recipe(), own.rows()) for own in runs], out)
    else:
        _plot_goals(runs[0], out)


def _plot_goals(runs: Batches, out: Path) -> None:
    recipe, goals = runs.homes[0].recipe(), runs.goal_map()
    if goals is None:
        raise ValueError(f"{runs.path} has no map of goals: its runs have written no virtual goals")
    task, algo = recipe.task.name, recipe.hindsight.algo
    plot_goals(goals, goal_env(make_task_envs(recipe, 1, [0])), out, title=f"virtual goals: {task}, {algo}")
