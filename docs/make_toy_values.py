"""Measures and draws estimated values of actions in bit flipping or in the treasure hunt.

    python docs/make_toy_values.py --study treasure_hunt    # trains into runs/treasure_hunt
    python docs/make_toy_values.py runs/treasure_hunt/her runs/treasure_hunt/filtered_her --out values.png

The first command trains a study with :class:`ToyValues` and draws its columns over environment steps. The
second draws the values after training, a panel for each folder.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import singledispatch
from pathlib import Path

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor

from torchrl_her.modules.networks import take_run
from torchrl_her_envs.common.goal_env import GoalEnv, goal_env
from torchrl_her_envs.toy.bit_flip import BitFlip
from torchrl_her_envs.toy.treasure_hunt import TreasureHunt
from torchrl_her_recipes import Callback, RunFolder, RunView, Study, build, load_study, run
from torchrl_her_recipes.components.agents import find_builder, shape_of
from torchrl_her_recipes.components.devices import place_of
from torchrl_her_recipes.components.envs import TaskEnvs
from torchrl_her_recipes.components.learner import acting
from torchrl_her_recipes.runs.plots import colors, count_frames, draw_curve, save_figure
from torchrl_her_recipes.runs.policy_file import read_policy
from torchrl_her_recipes.studies.seed_batches import Batches

STATES = 256  # for each number of wrong bits
LABELS = {
    "success": "success rate",
    "useless_share": "the useless action is best",
    "useless_margin": "useless action minus needed flip",
    "right_way": "pairs with the right way",
}
_KINDS = {"needed": "a needed flip", "needless": "a needless flip", "useless": "the useless action"}


class ToyValues(Callback):
    """Adds what the critic's values are worth to the table of metrics, after each epoch.

    In bit flipping with a useless action, over 1 to n wrong bits alike: ``useless_share``, how often that
    action has the highest value, and ``useless_margin``, its value minus the mean of needed flips. In the
    treasure hunt: ``right_way``, the share of pairs of place and treasure whose best action goes towards the
    treasure.
    """

    def on_epoch(self, run: RunView) -> None:
        """Measures the values of all runs, and completes their last rows."""
        runs = run.components.recipe.run.num_runs
        measured = measure_values(goal_env(run.components.eval_env), run.components.actor, runs)
        for name, values in measured.items():
            for row, value in zip(run.rows[-runs:], values.tolist(), strict=True):
                row[name] = value


@torch.no_grad()
def action_values(actor: TensorDictModuleBase, place: Tensor, goal: Tensor) -> Tensor:
    """The values [..., actions] of all actions in places [..., g] when goals [..., g] are desired."""
    seen = TensorDict({"observation": place, "desired_goal": goal}, place.shape[:-1])
    return actor(seen.to(place_of(actor)))["action_value"].to(place.device)


def some_wrong(
    bits: int, wrong: int, states: int, generator: torch.Generator | None = None
) -> tuple[Tensor, Tensor]:
    """Random places [states, bits] that differ from their goals in ``wrong`` bits, and these goals."""
    place = torch.randint(2, (states, bits), generator=generator).float()
    differs = torch.rand(states, bits, generator=generator).argsort(-1) < wrong
    return place, torch.where(differs, 1.0 - place, place)


def all_pairs(env: TreasureHunt) -> tuple[Tensor, Tensor]:
    """All places along the first dimension, all treasures along the second: [places, treasures, 1] both."""
    goals = env.goal_distribution
    points = goals.from_uniform((torch.arange(goals.count)[:, None] + 0.5) / goals.count).float()
    count = len(points)
    return points[:, None].expand(count, count, 1), points[None].expand(count, count, 1)


@singledispatch
def measure_values(env: GoalEnv, _actor: TensorDictModuleBase, _runs: int) -> dict[str, Tensor]:
    """Returns the columns of :class:`ToyValues` for R runs of DQN, [R] each."""
    raise ValueError(f"values of {env.task_name} cannot be measured; choose bit_flip or treasure_hunt")


@measure_values.register
def _measure_useless(env: BitFlip, actor: TensorDictModuleBase, runs: int) -> dict[str, Tensor]:
    if not env.useless_action:
        return {}
    bits = env.bits
    generator = torch.Generator().manual_seed(0)
    each = [some_wrong(bits, wrong, STATES, generator) for wrong in range(1, bits + 1)]
    place, goal = (torch.cat(own) for own in zip(*each, strict=True))
    values = action_values(actor, place.repeat(runs, 1), goal.repeat(runs, 1)).view(runs, len(place), -1)
    needed = (place != goal).float()
    flips, useless = values[..., :bits], values[..., bits]
    margin = useless - (flips * needed).sum(-1) / needed.sum(-1)
    return {
        "useless_share": (values.argmax(-1) == bits).float().mean(1),
        "useless_margin": margin.mean(1),
    }


@measure_values.register
def _measure_way(env: TreasureHunt, actor: TensorDictModuleBase, runs: int) -> dict[str, Tensor]:
    place, goal = (points.reshape(-1, 1) for points in all_pairs(env))
    apart = (place != goal).squeeze(-1)
    place, goal = place[apart], goal[apart]
    values = action_values(actor, place.repeat(runs, 1), goal.repeat(runs, 1)).view(runs, len(place), 2)
    right = values.argmax(-1) == (goal > place).squeeze(-1).long()
    return {"right_way": right.float().mean(1)}


def train(study: Study, folder: Path) -> None:
    """Trains each combination of a study in a folder of its own, one after the other."""
    for label, recipe in study.cells():
        run(build(recipe), folder / label, callbacks=[ToyValues()])


def plot_training(study: Study, folder: Path, path: Path) -> None:
    """Draws success and the columns of :class:`ToyValues` over environment steps, a panel for each."""
    curves = {label: Batches(folder / label).rows() for label, _ in study.cells()}
    measured = [name for name in LABELS if all(name in row for rows in curves.values() for row in rows)]
    palette = colors(list(curves))
    figure = Figure(figsize=(1.0 + 4.2 * len(measured), 3.8), layout="constrained")
    for axes, name in zip(figure.subplots(1, len(measured), squeeze=False)[0], measured, strict=True):
        for label, rows in curves.items():
            draw_curve(axes, rows, name, color=palette[label], label=label)
        count_frames(axes)
        axes.set(xlabel="environment steps of each run", ylabel=LABELS[name])
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    save_figure(figure, path)


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
        actors = [_load_actor(home, run) for home in own.homes for run in range(home.recipe().run.num_runs)]
        _draw(goal_env(TaskEnvs.of(recipe).make(1, [0])), axes, actors, recipe.learner.gamma)
        home = own.homes[0].path
        axes.set_title((home.parent if home.name.startswith("seeds_") else home).name)
    save_figure(figure, path)


def _load_actor(home: RunFolder, run: int) -> TensorDictModuleBase:
    """Returns the actor of a run of DQN, which gives the values of all actions."""
    recipe = home.recipe()
    shape = shape_of(recipe.task.name, recipe.replace(num_runs=1).run, TaskEnvs.of(recipe).make(1, [0]))
    builder = find_builder(recipe.learner, shape)
    actor = acting(builder.player(1), builder.norm())
    actor.load_state_dict(take_run(read_policy(home.policy)[1], run, recipe.run.num_runs))
    return actor


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
    parser.add_argument("runs", nargs="*", type=Path, help="folders of runs, or of a study's combinations")
    parser.add_argument("--study", help="train it, and draw what was measured: treasure_hunt, useless_action")
    parser.add_argument("--frames", type=int, help="with --study, environment steps of each run")
    parser.add_argument("--folder", type=Path, help="with --study, where the runs go (default: runs/STUDY)")
    parser.add_argument("--out", type=Path, default=Path("values.png"))
    options = parser.parse_args()
    if options.study is None:
        plot_values([Batches(folder) for folder in options.runs], options.out)
        return
    study = load_study(options.study, frames=options.frames)
    folder = options.folder or Path("runs") / study.name
    train(study, folder)
    plot_training(study, folder, options.out)


if __name__ == "__main__":
    main()
