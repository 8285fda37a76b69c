"""The weights of virtual goals that a recipe asks for, over the screen of its task."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from torchrl_her import GoalGrid, GoalHistogram, Instructiveness, box_target, sampled_target
from torchrl_her_envs import ThrowingEnv
from torchrl_her_recipes.algorithms import get_algorithm
from torchrl_her_recipes.recipe import Recipe

# Shares of the screen: the wall leaves the goals a smaller surrounding that can be reached.
_SIGMA, _SIGMAS = 0.2, {"hand_wall_v0": 0.1}
_SHOWN = 2.0  # the screen's width in shown coordinates
_SAMPLES = 10_000  # of goals that do not fill a box


def make_grid(recipe: Recipe) -> GoalGrid:
    """The grid over the screen."""
    return GoalGrid((-1.0, -1.0), (1.0, 1.0), (recipe.ibs_cells, recipe.ibs_cells))


def final_sigma(recipe: Recipe) -> float:
    """The sigma that the schedule ends at, in shown coordinates."""
    share = _SIGMAS.get(recipe.task, _SIGMA) if recipe.ibs_sigma is None else recipe.ibs_sigma
    return _SHOWN * share


def make_target(recipe: Recipe, env: ThrowingEnv, grid: GoalGrid) -> Callable[[float], Tensor]:
    """q* of the task's goals, for any sigma.

    Raises:
        ValueError: the algorithm prefers instructive goals, and those of the task lie around its start
            states.
    """
    goals = env.goal_distribution
    if get_algorithm(recipe.algo).instructive and not env.task.throws:
        raise ValueError(
            f"{recipe.algo} must not be used on {recipe.task}: its goals lie around its start states, so the "
            "goals that it would prefer are achieved without doing anything; choose a throwing task"
        )
    if goals.is_box and bool((goals.high > goals.low).all()):
        return partial(box_target, grid, goals.low, goals.high, name=recipe.task)
    samples = goals.sample(_SAMPLES, generator=torch.Generator().manual_seed(0))
    return partial(sampled_target, grid, samples)


def make_goal_weights(recipe: Recipe, env: ThrowingEnv) -> GoalHistogram:
    """The weights of one run's virtual goals; without IBS they only count where goals are written."""
    instructive, grid = get_algorithm(recipe.algo).instructive, make_grid(recipe)
    if instructive is None:
        return GoalHistogram(grid)
    return Instructiveness(
        grid,
        make_target(recipe, env, grid),
        sigma=final_sigma(recipe),
        start_factor=recipe.ibs_start_factor,
        decay=recipe.ibs_decay,
        floor=recipe.ibs_floor,
        subtract=instructive == "simultaneous",
    )


def goal_target(recipe: Recipe, env: ThrowingEnv) -> Tensor:
    """q* [cells] at the final sigma, which divergences are reported against."""
    return make_target(recipe, env, make_grid(recipe))(final_sigma(recipe))
