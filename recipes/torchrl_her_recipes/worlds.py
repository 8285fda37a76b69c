"""The environments that a recipe asks for: throwing tasks, small worlds, and gymnasium's with goals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch
from torchrl.envs import EnvBase

from torchrl_her_envs import SMALL_WORLDS, TASKS, make_env, make_gym_env

if TYPE_CHECKING:
    from torchrl_her_recipes.recipe import Recipe

GYM = "gym:"  # before the id of an environment that gymnasium knows
_SIZES: dict[str, dict[str, Any]] = {
    "bit_flip": {"bits": 15},
    "chain": {"length": 10, "forward_probability": 1.0},
}


def check_task(name: str) -> None:
    """Raises a ValueError that lists the tasks there are, if this is none of them."""
    if name not in TASKS and name not in SMALL_WORLDS and not name.startswith(GYM):
        known = ", ".join([*TASKS, *SMALL_WORLDS])
        raise ValueError(f"unknown task {name!r}; the tasks are {known}, or {GYM}ID for one of gymnasium's")


def make_worlds(recipe: Recipe, num_envs: int, seeds: Sequence[int]) -> EnvBase:
    """Worlds of the recipe's task: ``num_envs`` for each seed.

    Raises:
        ValueError: options that the task does not take.
    """
    total = num_envs * len(seeds)
    if recipe.task in TASKS:
        if recipe.task_options:
            raise ValueError(f"{recipe.task} takes no task_options, got {recipe.task_options}")
        dtype = getattr(torch, recipe.dtype)
        return make_env(recipe.task, num_envs=total, seed=seeds, threshold=recipe.threshold, dtype=dtype)
    for name, common in (("threshold", None), ("dtype", "float32")):
        if getattr(recipe, name) != common:
            raise ValueError(f"{name} is for throwing tasks; {recipe.task} has its own")
    try:
        options = _SIZES.get(recipe.task, {}) | dict(recipe.task_options or {})
        if recipe.task.startswith(GYM):
            return make_gym_env(recipe.task.removeprefix(GYM), num_envs=total, seed=seeds, **options)
        return SMALL_WORLDS[recipe.task](num_envs=total, seed=seeds, **options)
    except TypeError as error:  # an option that there is not
        options = recipe.task_options
        raise ValueError(f"{recipe.task} does not take task_options={options}: {error}") from error
