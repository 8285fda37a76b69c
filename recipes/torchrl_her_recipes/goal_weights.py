"""The weights of virtual goals that a recipe asks for, and the space of goals that they are over."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_her import GoalGrid, GoalHistogram, Instructiveness, box_target, sampled_target
from torchrl_her_envs import ThrowingEnv
from torchrl_her_recipes.algorithms import get_algorithm
from torchrl_her_recipes.recipe import Recipe
from torchrl_her_recipes.worlds import make_worlds

# Shares of the screen: the wall leaves the goals a smaller surrounding that can be reached.
_SIGMA, _SIGMAS = 0.2, {"hand_wall_v0": 0.1}
_SAMPLES = 10_000  # of goals that do not fill a box
_RESETS = 1_000  # episodes whose goals stand for an environment's, if it cannot tell where they come from
_SEED = 1 << 40  # of these, far from all that trains or evaluates
_MOST_DIMENSIONS = 3


@dataclass(frozen=True)
class GoalSpace:
    """Where goals lie, and where the task's own do.

    Attributes:
        grid: over the goals.
        target_at: q* [cells] of the task's goals, for a sigma in the unit of the goals.
        sigma: that the schedule ends at.
    """

    grid: GoalGrid
    target_at: Callable[[float], Tensor]
    sigma: float

    @property
    def target(self) -> Tensor:
        """q* at the final sigma, which divergences are reported against."""
        return self.target_at(self.sigma)


def goal_space(recipe: Recipe, env: EnvBase) -> GoalSpace | None:
    """The space of a task's goals: for throwing tasks the screen, for others only where weights need it.

    Raises:
        ValueError: the algorithm prefers instructive goals, and those of the task lie around its start
            states or have too many numbers for a grid.
    """
    instructive = get_algorithm(recipe.algo).instructive
    if isinstance(env, ThrowingEnv):
        if instructive and not env.task.throws:
            raise ValueError(
                f"{recipe.algo} must not be used on {recipe.task}: its goals lie around its start states, so "
                "the goals that it would prefer are achieved without doing anything; choose a throwing task"
            )
        return _screen(recipe, env)
    return _sampled(recipe, env) if instructive else None


def _screen(recipe: Recipe, env: ThrowingEnv) -> GoalSpace:
    """The screen of a throwing task."""
    goals = env.goal_distribution
    grid = GoalGrid((-1.0, -1.0), (1.0, 1.0), (recipe.ibs_cells, recipe.ibs_cells))
    target: Callable[[float], Tensor]
    if goals.is_box and bool((goals.high > goals.low).all()):
        target = partial(box_target, grid, goals.low, goals.high, name=recipe.task)
    else:
        samples = goals.sample(_SAMPLES, generator=torch.Generator().manual_seed(0))
        target = partial(sampled_target, grid, samples)
    return GoalSpace(grid, target, _share(recipe) * 2.0)


def _sampled(recipe: Recipe, env: EnvBase) -> GoalSpace:
    """A box around goals of the task, half as wide again on each side."""
    goals = _desired_goals(recipe, env).double()
    dimensions = goals.shape[-1]
    if dimensions > _MOST_DIMENSIONS:
        raise ValueError(
            f"{recipe.algo} must not be used on {recipe.task}: its goals have {dimensions} numbers, "
            f"and a grid is kept over {_MOST_DIMENSIONS} at most"
        )
    low, high = goals.amin(0), goals.amax(0)
    width = float((high - low).max()) or 1.0
    margin = torch.where(high > low, (high - low) / 2, width / 2)
    # Nobody chose this box: what is achieved outside of it is no mistake, and counts at its edge.
    grid = GoalGrid(low - margin, high + margin, [recipe.ibs_cells] * dimensions, warn=False)
    return GoalSpace(grid, partial(sampled_target, grid, goals), _share(recipe) * width)


def _desired_goals(recipe: Recipe, env: EnvBase) -> Tensor:
    """Goals [n, g] as episodes have them."""
    distribution = getattr(env, "goal_distribution", None)
    if distribution is not None:
        return distribution.sample(_SAMPLES, generator=torch.Generator().manual_seed(0))
    worlds = make_worlds(recipe, recipe.num_envs, [_SEED])
    resets = -(-_RESETS // recipe.num_envs)
    goals = torch.cat([worlds.reset()["desired_goal"] for _ in range(resets)])
    worlds.close()
    return goals


def _share(recipe: Recipe) -> float:
    """The final sigma as a share of the space."""
    return _SIGMAS.get(recipe.task, _SIGMA) if recipe.ibs_sigma is None else recipe.ibs_sigma


def make_goal_weights(recipe: Recipe, space: GoalSpace) -> GoalHistogram:
    """The weights of one run's virtual goals; without IBS they only count where goals are written."""
    instructive = get_algorithm(recipe.algo).instructive
    if instructive is None:
        return GoalHistogram(space.grid)
    return Instructiveness(
        space.grid,
        space.target_at,
        sigma=space.sigma,
        start_factor=recipe.ibs_start_factor,
        decay=recipe.ibs_decay,
        floor=recipe.ibs_floor,
        subtract=instructive == "simultaneous",
    )
