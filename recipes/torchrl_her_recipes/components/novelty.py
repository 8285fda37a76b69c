"""Weights that prefer rare or new goals, made by functions that the registry of algorithms names."""

from __future__ import annotations

from typing import Any

from torchrl_her.goals.rare import RareGoals
from torchrl_her.goals.rnd import NetworkNovelty
from torchrl_her_recipes.components.goal_space import MOST_DIMENSIONS, goal_width
from torchrl_her_recipes.config.recipe import Recipe


def rare_goals(recipe: Recipe, env: Any) -> RareGoals:
    """Goals with few others around them: by a kernel in few dimensions, by nearest neighbors in many."""
    return RareGoals(
        estimator="kernel" if goal_width(env) <= MOST_DIMENSIONS else "neighbors",
        sharpness=recipe.novelty.sharpness,
        memory=recipe.novelty.memory,
    )


def network_novelty(recipe: Recipe, _env: Any) -> NetworkNovelty:
    """Goals that are new to a network, whose first weights come from the run's seed."""
    sharpness = recipe.novelty.sharpness
    return NetworkNovelty(seed=recipe.run.seed, sharpness=1.0 if sharpness is None else sharpness)
