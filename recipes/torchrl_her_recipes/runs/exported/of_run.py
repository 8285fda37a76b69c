"""The policy of a run's folder, as one of its own: of one run, reading what its task shows."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_her.modules.networks import take_run
from torchrl_her_recipes.components.agents import find_learner
from torchrl_her_recipes.components.curricula import make_curriculum
from torchrl_her_recipes.components.envs import make_task_envs
from torchrl_her_recipes.config.recipe import Recipe
from torchrl_her_recipes.runs.exported.card import PolicyCard, describe_env, present_versions
from torchrl_her_recipes.runs.kept import KeptPolicy
from torchrl_her_recipes.runs.run import median_run


@dataclass(frozen=True)
class PolicyOfRun:
    """A policy that a run kept, its success not measured yet.

    Attributes:
        card: what it reads and writes, and what made it.
        recipe: of that run alone.
        weights: of its network, which reads all that the task shows.
    """

    card: PolicyCard
    recipe: Recipe
    weights: dict[str, Tensor]


def read_run(kept: KeptPolicy, run: int | None) -> PolicyOfRun:
    """One of the policies that runs side by side have kept.

    Args:
        kept: the file in their folder.
        run: which one; the median of them if None.

    Raises:
        ValueError: there is no such run, the file is damaged, or the task names a module that must not be
            imported.
        OSError: the run has not saved a policy yet.
    """
    recipe, rows = kept.home.recipe(), kept.home.rows()
    if not rows:
        raise ValueError(f"the run in {kept.home.path} has not been evaluated yet")
    state = kept.load()
    rows = [row for row in rows if row["epoch"] <= state.get("epoch", math.inf)]
    chosen = median_run(rows) if run is None else run
    runs = recipe.run.num_runs
    if chosen not in range(runs):
        raise ValueError(f"there is no run {chosen} in {kept.home.path}; it has runs 0 to {runs - 1}")
    env = make_task_envs(recipe, 1, [0], scaled=False)
    shown: dict[str, Any] = describe_env(env)
    card = PolicyCard(
        task=recipe.task.name,
        **shown,
        normalize_clip=recipe.learner.normalize_clip if recipe.learner.normalize else None,
        algorithm=recipe.hindsight.algo,
        learner=find_learner(recipe, env).name,
        seed=recipe.run.seed + chosen,
        frames=int(rows[-1]["frames"]),
        versions=present_versions(),
    )
    card = replace(card, dtype=recipe.run.dtype)
    if not card.discrete:
        card = replace(card, action_dtype=recipe.run.dtype)
    weights = _as_shown(take_run(state["actor"], chosen, runs), _seen(recipe, env), sum(card.widths.values()))
    return PolicyOfRun(card, recipe.replace(num_runs=1, seed=recipe.run.seed + chosen), weights)


def _seen(recipe: Recipe, env: EnvBase) -> tuple[int, ...]:
    """Where each input of a run's policy is in the observation and the desired goal behind it."""
    curriculum = make_curriculum(recipe, env)
    if curriculum is None:
        return tuple(range(sum(describe_env(env)["widths"].values())))
    last = curriculum.layers[-1]
    return (*last.observation, *last.desired_goal)


def _as_shown(actor: dict[str, Tensor], places: tuple[int, ...], width: int) -> dict[str, Tensor]:
    """The weights of an actor with its inputs in other places; it does not see the rest.

    Args:
        actor: the weights, and its normalization if there is one.
        places: of each input.
        width: how many inputs there are then.
    """
    index, moved = torch.tensor(places), dict(actor)
    for key, value in actor.items():
        if key.endswith("layers.0.0.weight"):
            moved[key] = _wider(value, -2, width).index_add(-2, index, value)
        elif key in ("norm.n", "norm.mean", "norm.var"):
            moved[key] = _wider(value, -1, width, key == "norm.var").index_copy(-1, index, value)
    return moved


def _wider(value: Tensor, dim: int, width: int, fill: float = 0.0) -> Tensor:
    shape = list(value.shape)
    shape[dim] = width
    return value.new_full(shape, fill)
