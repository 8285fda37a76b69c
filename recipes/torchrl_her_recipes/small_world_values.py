"""What agents make of the small worlds: values of actions in bit flipping and in the treasure hunt."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor

from torchrl_her_envs import BitFlip, GoalEnv, TreasureHunt, goal_env
from torchrl_her_recipes.playing import load_actor
from torchrl_her_recipes.run_folder import RunFolder
from torchrl_her_recipes.worlds import make_worlds

_STATES = 256  # for each number of wrong bits
_KINDS = {"needed": "a needed flip", "needless": "a needless flip", "useless": "the useless action"}


@torch.no_grad()
def action_values(actor: TensorDictModule, place: Tensor, goal: Tensor) -> Tensor:
    """The values [..., actions] of all actions in places [..., g] when goals [..., g] are desired."""
    seen = {"observation": place, "desired_goal": goal}
    return actor(TensorDict(seen, place.shape[:-1]))["action_value"]


def values_by_wrong_bits(
    actor: TensorDictModule, bits: int, *, states: int = _STATES, generator: torch.Generator | None = None
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
        place = torch.randint(2, (states, bits), generator=generator).float()
        order = torch.rand(states, bits, generator=generator).argsort(-1)
        differs = order < wrong
        values = action_values(actor, place, torch.where(differs, 1.0 - place, place))
        flips = values[:, :bits]
        kinds.setdefault("needed", []).append(flips[differs].mean())
        kinds.setdefault("needless", []).append(flips[~differs].mean())
        if values.shape[1] > bits:
            kinds.setdefault("useless", []).append(values[:, bits].mean())
    return {kind: torch.stack(means) for kind, means in kinds.items()}


def true_values(wrong: Tensor, gamma: float) -> Tensor:
    """The value of a flip that is needed when ``wrong`` bits are, with -1 for all steps but the last."""
    return -(1.0 - gamma ** (wrong - 1.0)) / (1.0 - gamma)


def values_on_the_line(actor: TensorDictModule, env: TreasureHunt) -> Tensor:
    """The values [places, treasures, 2] of going left and right, for all places and treasures."""
    goals = env.goal_distribution
    points = goals.from_uniform((torch.arange(goals.count)[:, None] + 0.5) / goals.count).float()
    count = len(points)
    place = points[:, None].expand(count, count, 1)
    return action_values(actor, place, points[None].expand(count, count, 1))


def plot_values(runs: Mapping[str, RunFolder], path: Path) -> None:
    """Draws what runs make of their small world, one panel for each; the mean of the runs in a folder.

    Args:
        runs: title of each panel to the folder of its run.
        path: of the picture.

    Raises:
        ValueError: no run, runs of different tasks, or of a task that this is not for.
    """
    tasks = {home.recipe().task for home in runs.values()}
    if len(tasks) != 1 or not tasks <= {"bit_flip", "treasure_hunt"}:
        raise ValueError(f"values are drawn of runs of bit_flip or of treasure_hunt, got {sorted(tasks)}")
    figure = Figure(figsize=(1.0 + 4.4 * len(runs), 4.0), layout="constrained")
    grid = figure.subplots(1, len(runs), sharey=True, squeeze=False)[0]
    for axes, (title, home) in zip(grid, runs.items(), strict=True):
        recipe = home.recipe()
        actors = [load_actor(home.path, run=run) for run in range(recipe.num_runs)]
        _draw(axes, actors, goal_env(make_worlds(recipe, 1, [0])), recipe.gamma)
        axes.set_title(title)
    figure.savefig(path, dpi=110)


def _draw(axes: Axes, actors: list[TensorDictModule], env: GoalEnv, gamma: float) -> None:
    if isinstance(env, BitFlip):
        _draw_bits(axes, actors, env, gamma)
    elif isinstance(env, TreasureHunt):
        _draw_line(axes, actors, env)


def _draw_bits(axes: Axes, actors: list[TensorDictModule], env: BitFlip, gamma: float) -> None:
    generator = torch.Generator().manual_seed(0)
    each = [values_by_wrong_bits(actor, env.bits, generator=generator) for actor in actors]
    wrong = torch.arange(env.bits + 1)
    for kind in each[0]:
        axes.plot(wrong, torch.stack([own[kind] for own in each]).mean(0), label=_KINDS[kind])
    axes.plot(wrong[1:], true_values(wrong[1:], gamma), "k:", label="a needed flip, in truth")
    axes.set(xlabel="wrong bits", ylabel="estimated value")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)


def _draw_line(axes: Axes, actors: list[TensorDictModule], env: TreasureHunt) -> None:
    values = torch.stack([values_on_the_line(actor, env) for actor in actors]).mean(0)
    picture = axes.imshow(values.amax(-1).T, origin="lower", extent=(0, 100, 0, 100), cmap="viridis")
    axes.contour(
        *(torch.linspace(0, 100, values.shape[0]) for _ in range(2)),
        (values[..., 1] - values[..., 0]).T,
        levels=[0.0],
        colors="white",
    )
    axes.set(xlabel="place of the pirate (goes right above the white line)", ylabel="place of the treasure")
    axes.figure.colorbar(picture, ax=axes, label="estimated value", shrink=0.8)
