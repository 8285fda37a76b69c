"""The environments that a recipe asks for."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torchrl.envs import EnvBase

from torchrl_her_envs.registry import make_env
from torchrl_her_recipes.config.recipe import Recipe


def make_task_envs(recipe: Recipe, num_envs: int, seeds: Sequence[int]) -> EnvBase:
    """Environments of the recipe's task: ``num_envs`` for each seed.

    Raises:
        ValueError: options that the task does not take.
    """
    task = recipe.task
    options: dict[str, Any] = dict(task.options or {})
    if task.threshold is not None:
        options["threshold"] = task.threshold
    if recipe.run.dtype != "float32":
        options["dtype"] = getattr(torch, recipe.run.dtype)
    return make_env(task.name, num_envs=num_envs * len(seeds), seed=seeds, **options)
