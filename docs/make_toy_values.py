"""Draws estimated values of actions in bit flipping or in the treasure hunt, a panel for each folder.

torchrl-her study treasure_hunt --folder runs/treasure_hunt
python docs/make_toy_values.py runs/treasure_hunt/her runs/treasure_hunt/filtered_her --out values.png
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import singledispatch
from pathlib import Path

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor

from torchrl_her_envs.common.goal_env import GoalEnv, goal_env
from torchrl_her_envs.toy.bit_flip import BitFlip
from torchrl_her_envs.toy.treasure_hunt import TreasureHunt
from torchrl_her_recipes.components.envs import make_task_envs
from torchrl_her_recipes.runs.play import load_actor
from torchrl_her_recipes.runs.plots import save_figure
from torchrl_her_recipes.runs.toy_values import STATES, action_values, all_pairs, some_wrong
from torchrl_her_recipes.studies.seed_batches import Batches

_KINDS = {"needed": "a needed flip", "needless": "a needless flip", "useless": "the useless action"}


def values_by_wrong_bits(
    actor: TensorDictModuleBase, bits: int, *, states: int = STATES, generator: torch.Generator | None = None
) -> dict[str, Tensor]:
    """Mean values of each kind of action over the number of wrong bits, from 0 to ``bits``.

    Args:
        actor: of DQN, for :class:`~torchrl_her_envs.BitFlip`.
        bits: n.
        states: random ones for each number of wrong bits.
        generator: of these.

    Returns:
        [n + 1] for ``needed`` and ``needless`` flips, and for the ``useless`` action if there is one; NaN
        where there is no such flip.
    """
    kinds: dict[str, list[Tensor]] = {}
    for wrong in range(bits + 1):
        place, goal = some_wrong(bits, wrong, states, generator)
        differs = place != goal
        values = action_values(actor, place, goal)
        flips = values[:, :bits]
        kinds.setdefault("needed", []).append(flips[differs].mean())
        kinds.setdefault("needless", []).append(flips[~differs].mean())
        if values.shape[1] > bits:
            kinds.setdefault("useless", []).append(values[:, bits].mean())
    return {kind: torch.stack(means) for kind, means in kinds.items()}


def true_values(wrong: Tensor, gamma: float) -> Tensor:
    """The value of a flip that is needed when ``wrong`` bits are, with -1 for all steps but the last."""
    return -(1.0 - gamma ** (wrong - 1.0)) / (1.0 - gamma)


def values_on_the_line(actor: TensorDictModuleBase, env: TreasureHunt) -> Tensor:
    """The values [places, treasures, 2] of going left and right, for all places and treasures."""
    return action_values(actor, *all_pairs(env))


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


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", nargs="+", type=Path, help="folders of runs, or of a study's combinations")
    parser.add_argument("--out", type=Path, default=Path("values.png"))
    options = parser.parse_args()
    plot_values([Batches(folder) for folder in options.runs], options.out)


if __name__ == "__main__":
    main()
