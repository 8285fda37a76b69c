"""Normalization of what the networks of a recipe see."""

from __future__ import annotations

from collections.abc import Mapping

from tensordict.nn import TensorDictModuleBase

from torchrl_her.modules.normalization import RunningNorm
from torchrl_her.modules.normalized import NormalizedPolicy
from torchrl_her_recipes.config.recipe import Recipe


def make_norm(recipe: Recipe, widths: Mapping[str, int]) -> RunningNorm | None:
    """The statistics of each run, before anything was counted; None if the recipe does not normalize."""
    if not recipe.learner.normalize:
        return None
    own = recipe.learner
    return RunningNorm(
        dict(widths), runs=recipe.run.num_runs, clip=own.normalize_clip, least_std=own.normalize_least_std
    )


def acting(actor: TensorDictModuleBase, norm: RunningNorm | None) -> TensorDictModuleBase:
    """An actor as it plays, on what environments show."""
    return actor if norm is None else NormalizedPolicy(actor, norm)
