"""Replaces the value ``auto`` of options by values computed from the task's environment."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from torchrl_her_envs.registry import get_task_spec
from torchrl_her_recipes.config.groups import CollectionConfig, RunConfig, TaskConfig
from torchrl_her_recipes.config.options import AUTO
from torchrl_her_recipes.config.recipe import Recipe
from torchrl_her_recipes.config.shortcuts import locate
from torchrl_her_recipes.config.without_effect import without_effect

TERMINATION = "termination"  # option of a task: the rule that ends an episode at its goal
SHAPING = "shaping"  # option of a task: distances between which rewards of missed goals grow
_WARMUP = 1_000  # least number of environment steps before the first gradient step
_EPISODES = 100  # episodes in an epoch if environments are stepped one by one
# Options that algo=auto sets if it chooses a curriculum and goals have equal weights
_AT_ONCE = {"order": "all_at_once", "every_stage": True, "task_share": 1.0}
_STAGE_EPOCHS = 10  # value of stage_epochs that algo=auto sets if goals have weights


@dataclass(frozen=True, kw_only=True)
class EnvFacts:
    """Facts about a task's environment on which the values of ``auto`` depend.

    Args:
        max_steps: largest number of steps in an episode.
        batched: whether all environments are stepped in one call, so that each additional one costs little.
        stages: stages of a curriculum for a task in which random actions seldom change the achieved goal;
            else None.
        shaping: value of ``task.options.shaping`` for a task in which random actions never come near the
            desired goal; else None.
        ends: value of ``task.options.termination`` that fits the environment; None if the task has no such
            option.
    """

    max_steps: int
    batched: bool = False
    stages: Any = None
    shaping: list[float] | None = None
    ends: str | None = None


def _num_envs(processes: int, facts: EnvFacts) -> int:
    """Returns a number of environments: few if they are slow, so that learning begins after few steps."""
    processes = max(processes, 1)
    return math.ceil((64 if facts.batched else 8) / processes) * processes


def _epoch_frames(collection: CollectionConfig, run: RunConfig, facts: EnvFacts) -> int:
    episodes = _EPISODES if not facts.batched else 4 * collection.num_envs
    frames = episodes * facts.max_steps
    if run.frames is not None:  # a run shorter than an epoch is one epoch of its own length
        frames = min(frames, run.frames)
    return max(frames, collection.num_envs * collection.steps_per_batch)


def _gamma(recipe: Recipe, facts: EnvFacts) -> float:
    """Returns a discount with a horizon 1 / (1 - gamma) of half an episode, or of a tenth.

    Shaped rewards pay at once for each step that brings a goal nearer.
    """
    shaped = (recipe.task.options or {}).get(SHAPING)
    horizon, least = (facts.max_steps / 10, 0.8) if shaped else (facts.max_steps / 2, 0.9)
    return round(min(max(1 - 1 / horizon, least), 0.99), 4)


# Computed in this order: later values depend on earlier ones.
_VALUES: dict[str, Callable[[Recipe, EnvFacts], Any]] = {
    "algo": lambda _recipe, facts: "cher" if facts.stages else "filtered_her",
    "goal_sources": lambda recipe, _facts: recipe.hindsight.sources,
    "gamma": _gamma,
    "num_envs": lambda recipe, facts: _num_envs(recipe.collection.processes, facts),
    "frames_per_update": lambda _recipe, facts: 5.0 if facts.batched else 1.0,
    "epoch_frames": lambda recipe, facts: _epoch_frames(recipe.collection, recipe.run, facts),
    # Learning begins when each environment has ended an episode: transitions are stored at an episode's end.
    "warmup_frames": lambda recipe, facts: max(recipe.collection.num_envs * facts.max_steps, _WARMUP),
}


def auto_options(recipe: Recipe) -> list[tuple[str, str]]:
    """Returns group and name of each option that is ``auto`` and has an effect: it must get a value.

    Example:
        >>> auto_options(Recipe().replace(gamma=0.95))[1:3]
        [('hindsight', 'goal_sources'), ('collection', 'num_envs')]
    """
    idle = without_effect(recipe)
    return [
        (group, name)
        for group, name in map(locate, _VALUES)
        if getattr(getattr(recipe, group), name) == AUTO and (group, name) not in idle
    ]


def left_open(task: TaskConfig, option: str) -> bool:
    """Returns whether an option of the task exists and has its default, so that a value may be found for it.

    Example:
        >>> push = TaskConfig(name="gym:FetchPush-v4")
        >>> never = TaskConfig(name="gym:FetchPush-v4", options={"termination": "never"})
        >>> [left_open(task, "termination") for task in (push, never, TaskConfig())]
        [True, False, False]
    """
    known = get_task_spec(task.name).options
    return option in known and (task.options or {}).get(option, known[option]) == known[option]


def resolve(recipe: Recipe, facts: EnvFacts) -> Recipe:
    """Returns a copy of a recipe with a value for each option that was ``auto``.

    Example:
        >>> recipe = resolve(Recipe(), EnvFacts(max_steps=50))
        >>> recipe.learner.gamma, recipe.collection.num_envs, recipe.collection.epoch_frames
        (0.96, 8, 5000)
    """
    if facts.stages and recipe.hindsight.algo != AUTO:
        recipe = recipe.replace(stages=facts.stages)
    if facts.ends is not None and left_open(recipe.task, TERMINATION):
        recipe = recipe.replace(**{f"task.options.{TERMINATION}": facts.ends})
    if facts.shaping and left_open(recipe.task, SHAPING):
        recipe = recipe.replace(**{f"task.options.{SHAPING}": facts.shaping})
    for group, name in auto_options(recipe):
        values = {f"{group}.{name}": _VALUES[name](recipe, facts)}
        if name == "algo" and facts.stages:
            values |= {"stages": facts.stages, "guided_share": 0.5, "guided_per": "step"}
            # Weights compare the goals of one stage only, so weighted goals need one stage at a time.
            values |= _AT_ONCE if recipe.weights.name == "none" else {"stage_epochs": _STAGE_EPOCHS}
        recipe = recipe.replace(**values)
    return recipe
