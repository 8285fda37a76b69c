"""The weights of virtual goals that a recipe asks for, and the space that goals lie in."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torchrl.data import TensorDictReplayBuffer
from torchrl.envs import EnvBase

from torchrl_her.goals.grid import GoalGrid, box_target, sampled_target
from torchrl_her.goals.ibs import GoalHistogram, Instructiveness
from torchrl_her.goals.instructive import InstructiveWeights
from torchrl_her.goals.kernel_ibs import KernelInstructiveness
from torchrl_her.goals.weights import GoalWeights
from torchrl_her.replay_buffers.writer import HERWriter
from torchrl_her_envs.common.goal_env import Box, goal_env
from torchrl_her_recipes.components.envs import make_task_envs
from torchrl_her_recipes.components.streams import Stream
from torchrl_her_recipes.config.algorithms import get_algorithm
from torchrl_her_recipes.config.recipe import Recipe
from torchrl_her_recipes.config.values import load_name

_SAMPLES = 10_000  # goals, if they do not fill a box
_RESETS = 1_000  # episodes whose goals are collected, if the environment has no distribution of goals
MOST_DIMENSIONS = 3  # that a grid is kept over


@dataclass(frozen=True)
class GoalSpace:
    """A grid over the goals of a task, and where on it the task's own goals lie.

    Attributes:
        grid: over the goals.
        target_at: gives q* [cells] of the task's goals for a sigma in the unit of the goals.
        sigma: the final one.
    """

    grid: GoalGrid
    target_at: Callable[[float], Tensor]
    sigma: float

    @property
    def target(self) -> Tensor:
        """q* [cells] at the final sigma; reported divergences are to it."""
        return self.target_at(self.sigma)


@dataclass(frozen=True)
class KernelSpace:
    """Goals of the task itself, where no grid is kept over them.

    Attributes:
        goals: [n, g].
        sigma: the final one, in the unit of the goals.
    """

    goals: Tensor
    sigma: float

    @property
    def target(self) -> None:
        """There are no cells that reported divergences could be to."""
        return None


def goal_space(recipe: Recipe, env: EnvBase) -> GoalSpace | KernelSpace | None:
    """The space of a task's goals: the range that the task states, or else a box around goals of it.

    For kernel densities it is goals of the task. None if the task states no range and the algorithm does
    not need one.

    Raises:
        ValueError: the algorithm prefers instructive goals, but the goals of the task lie around its
            start states, or a grid is asked for and they have too many coordinates for one.
    """
    task, algorithm = goal_env(env), recipe.hindsight.algo
    proposed = recipe.behavior.instructive
    instructive = proposed or get_algorithm(algorithm).instructive
    if instructive and task.starts_near_goals:
        user = f"behavior={recipe.behavior.name}" if proposed else algorithm
        raise ValueError(
            f"{user} must not be used on {recipe.task.name}: its goals lie around its start states, so the "
            "goals that it would prefer are achieved without doing anything; choose a throwing task"
        )
    box = task.goal_box()
    if instructive and _without_grid(recipe, task):
        return _kernel(recipe, task, box)
    if box is not None:
        return _given(recipe, task, *box)
    return _sampled(recipe, task) if instructive else None


def goal_width(env: Any) -> int:
    """How many numbers a goal of a task has."""
    return int(env.observation_spec["desired_goal"].shape[-1])


def _without_grid(recipe: Recipe, env: Any) -> bool:
    """Whether q* and q are kernel densities."""
    choice, width = recipe.ibs.estimator, goal_width(env)
    if choice == "grid" and width > MOST_DIMENSIONS:
        raise ValueError(
            f"estimator=grid cannot be on {recipe.task.name}: its goals have {width} numbers, and a grid is "
            f"kept over {MOST_DIMENSIONS} at most; choose kernel"
        )
    return choice == "kernel" or (choice == "auto" and width > MOST_DIMENSIONS)


def _kernel(recipe: Recipe, env: Any, box: Box | None) -> KernelSpace:
    """Goals of the task. Its own share for sigma grows with the root of their width, as distances do."""
    if recipe.ibs.recent is not None:
        raise ValueError(
            f"recent={recipe.ibs.recent} has no effect on {recipe.task.name}, where q is a kernel density: "
            "leave it out"
        )
    goals = _desired_goals(recipe, env).double()
    low, high = (goals.amin(0), goals.amax(0)) if box is None else map(goals.new_tensor, box)
    width = float((high - low).max()) or 1.0
    wider = math.sqrt(max(1.0, goals.shape[-1] / MOST_DIMENSIONS)) if recipe.ibs.sigma is None else 1.0
    return KernelSpace(goals, _share(recipe, env) * width * wider)


def _given(recipe: Recipe, env: Any, low: Sequence[float], high: Sequence[float]) -> GoalSpace:
    """The range of goals that an environment states."""
    goals = env.goal_distribution
    grid = GoalGrid(low, high, [recipe.ibs.cells] * len(low))
    target: Callable[[float], Tensor]
    if goals.is_box and bool((goals.high > goals.low).all()):
        target = partial(box_target, grid, goals.low, goals.high, name=recipe.task.name)
    else:
        samples = goals.sample(_SAMPLES, generator=torch.Generator().manual_seed(0))
        target = partial(sampled_target, grid, samples)
    return GoalSpace(grid, target, _share(recipe, env) * max(b - a for a, b in zip(low, high, strict=True)))


def _sampled(recipe: Recipe, env: Any) -> GoalSpace:
    """A box around goals of the task, half as wide again on each side."""
    goals = _desired_goals(recipe, env).double()
    low, high = goals.amin(0), goals.amax(0)
    width = float((high - low).max()) or 1.0
    margin = torch.where(high > low, (high - low) / 2, width / 2)
    # This box is a guess, so goals outside of it count at its edge without a warning.
    grid = GoalGrid(low - margin, high + margin, [recipe.ibs.cells] * goals.shape[-1], warn=False)
    return GoalSpace(grid, partial(sampled_target, grid, goals), _share(recipe, env) * width)


def _desired_goals(recipe: Recipe, env: Any) -> Tensor:
    """Goals [n, g] as episodes have them."""
    distribution = getattr(env, "goal_distribution", None)
    if distribution is not None:
        return distribution.sample(_SAMPLES, generator=torch.Generator().manual_seed(0))
    envs = make_task_envs(recipe, recipe.collection.num_envs, [Stream.GOAL_SPACE])
    resets = -(-_RESETS // recipe.collection.num_envs)
    goals = torch.cat([envs.reset()["desired_goal"] for _ in range(resets)])
    envs.close()
    return goals


def _share(recipe: Recipe, env: Any) -> float:
    """The final sigma as a share of the space."""
    return env.goal_sigma if recipe.ibs.sigma is None else recipe.ibs.sigma


def make_goal_weights(recipe: Recipe, env: Any, space: GoalSpace | KernelSpace | None) -> GoalWeights | None:
    """The weights of one run's virtual goals; without IBS they are equal and goals are only counted."""
    algorithm = get_algorithm(recipe.hindsight.algo)
    if algorithm.weights:
        return load_name(algorithm.weights)(recipe, env)
    if space is None:
        return None
    if algorithm.instructive is None:
        return GoalHistogram(space.grid, recent=recipe.ibs.recent) if isinstance(space, GoalSpace) else None
    return make_instructive(recipe, space, subtract=algorithm.instructive == "simultaneous")


def make_instructive(
    recipe: Recipe, space: GoalSpace | KernelSpace, *, subtract: bool = True
) -> InstructiveWeights:
    """The weights of IBS over the goals of a task."""
    options: dict[str, Any] = {
        "sigma": space.sigma,
        "start_factor": recipe.ibs.start_factor,
        "decay": recipe.ibs.decay,
        "floor": recipe.ibs.floor,
        "subtract": subtract,
    }
    if isinstance(space, KernelSpace):
        return KernelInstructiveness(space.goals, **options)
    options |= {"recent": recipe.ibs.recent, "floor_is_relative": recipe.ibs.floor_is_relative}
    return Instructiveness(space.grid, space.target_at, **options)


def histograms(buffer: TensorDictReplayBuffer) -> list[GoalHistogram]:
    """The histograms of virtual goals of the runs; empty if they are not counted."""
    return [own for own in goal_weights(buffer) if isinstance(own, GoalHistogram)]


def scheduled(weights: Sequence[GoalWeights]) -> list[InstructiveWeights]:
    """Those of some weights that change from epoch to epoch."""
    return [own for own in weights if isinstance(own, InstructiveWeights)]


def goal_weights(buffer: TensorDictReplayBuffer) -> list[GoalWeights]:
    """The weights of the virtual goals of the runs; empty if there are none."""
    return buffer.writer.goal_weights if isinstance(buffer.writer, HERWriter) else []
