"""Pictures of what agents make of bit flipping and of the treasure hunt."""

from __future__ import annotations

from collections.abc import Sequence
from functools import singledispatch
from pathlib import Path

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from tensordict.nn import TensorDictModule

from torchrl_her_envs.common.goal_env import GoalEnv, goal_env
from torchrl_her_envs.toy.bit_flip import BitFlip
from torchrl_her_envs.toy.treasure_hunt import TreasureHunt
from torchrl_her_recipes.components.envs import make_task_envs
from torchrl_her_recipes.runs.play import load_actor
from torchrl_her_recipes.runs.plots import save_figure
from torchrl_her_recipes.runs.toy_values import true_values, values_by_wrong_bits, values_on_the_line
from torchrl_her_recipes.studies.seed_batches import Batches

_KINDS = {"needed": "a needed flip", "needless": "a needless flip", "useless": "the useless action"}


def plot_values(runs: Sequence[Batches], path: Path) -> None:
    """Draws what runs make of their toy environment, a panel for each folder; the mean of the runs in it.

    Args:
        runs: what each folder holds.
        path: of the picture.

    Raises:
        ValueError: no run, runs of different tasks, or of a task that this is not for.
    """
    tasks = {home.recipe().task.name for own in runs for home in own.homes}
    if len(tasks) != 1 or not tasks <= {"bit_flip", "treasure_hunt"}:
        raise ValueError(f"values are drawn of runs of bit_flip or of treasure_hunt, got {sorted(tasks)}")
    figure = Figure(figsize=(1.0 + 4.4 * len(runs), 4.0), layout="constrained")
    grid = figure.subplots(1, len(runs), sharey=True, squeeze=False)[0]
    for axes, own in zip(grid, runs, strict=True):
        recipe = own.homes[0].recipe()
        actors = [
            load_actor(home.path, run=run) for home in own.homes for run in range(home.recipe().run.num_runs)
        ]
        _draw(goal_env(make_task_envs(recipe, 1, [0])), axes, actors, recipe.learner.gamma)
        axes.set_title(own.path.name)
    save_figure(figure, path)


@singledispatch
def _draw(env: GoalEnv, _axes: Axes, _actors: list[TensorDictModule], _gamma: float) -> None:
    """Another environment takes part by a function that is registered for its class."""
    raise ValueError(f"values of {env.task_name} cannot be drawn")


@_draw.register
def _draw_bits(env: BitFlip, axes: Axes, actors: list[TensorDictModule], gamma: float) -> None:
    generator = torch.Generator().manual_seed(0)
    each = [values_by_wrong_bits(actor, env.bits, generator=generator) for actor in actors]
    wrong = torch.arange(env.bits + 1)
    for kind in each[0]:
        axes.plot(wrong, torch.stack([own[kind] for own in each]).mean(0), label=_KINDS[kind])
    axes.plot(wrong[1:], true_values(wrong[1:], gamma), "k:", label="a needed flip, in truth")
    axes.set(xlabel="wrong bits", ylabel="estimated value")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)


@_draw.register
def _draw_line(env: TreasureHunt, axes: Axes, actors: list[TensorDictModule], _gamma: float) -> None:
    values = torch.stack([values_on_the_line(actor, env) for actor in actors]).mean(0)
    places = torch.linspace(0, 100, values.shape[0])
    low, high = -float(places[1]) / 2, 100 + float(places[1]) / 2  # places are in the middle of their cells
    picture = axes.imshow(values.amax(-1).T, origin="lower", extent=(low, high, low, high), cmap="viridis")
    axes.contour(
        places,
        places,
        (values[..., 1] - values[..., 0]).T,
        levels=[0.0],
        colors="white",
    )
    axes.set(xlabel="place of the pirate (goes right above the white line)", ylabel="place of the treasure")
    axes.figure.colorbar(picture, ax=axes, label="estimated value", shrink=0.8)
