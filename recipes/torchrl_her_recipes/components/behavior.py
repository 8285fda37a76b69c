"""The behavior goals that a recipe asks for."""

from __future__ import annotations

from typing import Any

from torchrl.envs import EnvBase

from torchrl_her.behavior import (
    BehaviorGoals,
    DiscoverScore,
    GoalFactor,
    GoalValues,
    InverseDensity,
    ValueCutoff,
)
from torchrl_her.curriculum.transforms import ZeroPad
from torchrl_her_envs.common.goal_env import goal_env
from torchrl_her_recipes.components.curricula import CurriculumState, at_the_top
from torchrl_her_recipes.components.envs import evaluation_envs, task_reward
from torchrl_her_recipes.components.goal_space import GoalSpace, KernelSpace, make_instructive
from torchrl_her_recipes.components.learner import Agent
from torchrl_her_recipes.components.streams import Stream, generators_of
from torchrl_her_recipes.config.recipe import Recipe

_GREEDY = ("mega", "discover")


def make_behavior(
    recipe: Recipe,
    env: EnvBase,
    *,
    rewards: tuple[float, float] = (-1.0, 0.0),
    space: GoalSpace | KernelSpace | None = None,
    state: CurriculumState | None = None,
) -> BehaviorGoals | None:
    """The transform that proposes goals, still without the factors that need networks; None without any."""
    options = recipe.behavior
    if options.name == "real":
        return None
    if recipe.collection.processes > 0:
        raise ValueError(
            f"behavior={options.name} proposes goals that this process has collected: it needs processes=0, "
            f"got processes={recipe.collection.processes}"
        )
    if options.goal_memory < recipe.collection.num_envs:
        raise ValueError(
            f"goal_memory={options.goal_memory} must be at least num_envs={recipe.collection.num_envs}, "
            "whose goals come at once"
        )
    own = []
    if options.name == "ibs" and space is not None:
        own = [make_instructive(recipe, space) for _ in recipe.seeds]
    top: dict[str, Any] = {}
    if state is not None and state.progress.by_episode:
        top = {"layer_key": "layer", "layer": len(state.curriculum) - 1}
    behavior = _goals(
        recipe,
        env,
        rewards,
        weights=own or None,
        update_on="proposed" if options.name == "ibs" else "achieved",
        greedy=options.name in _GREEDY,
        real_share=options.real_share,
        candidates=options.candidates,
        memory=options.goal_memory,
        **top,
    )
    if state is not None:
        for run in range(recipe.run.num_runs):
            behavior.set_active(state.at_the_top(run), run=run)
    return behavior


def make_asking(recipe: Recipe, env: EnvBase, *, rewards: tuple[float, float] = (-1.0, 0.0)) -> BehaviorGoals:
    """The transform that lets episodes ask for any goals that are put into its memory, for evaluation."""
    memory = evaluation_envs(recipe)
    return _goals(recipe, env, rewards, remember=False, real_share=0.0, candidates=1, memory=memory)


def _goals(recipe: Recipe, env: EnvBase, rewards: tuple[float, float], **options: Any) -> BehaviorGoals:
    return BehaviorGoals(
        task_reward(env),
        runs=recipe.run.num_runs,
        generators=generators_of(recipe, Stream.PROPOSED_GOALS),
        achieved_reward=rewards[1],
        continues_after_termination=goal_env(env).continues_after_termination,
        **options,
    )


def make_factors(
    recipe: Recipe, agent: Agent, state: CurriculumState | None, rewards: tuple[float, float]
) -> list[GoalFactor]:
    """The factors of proposed goals that ask the agent's networks."""
    name, runs = recipe.behavior.name, recipe.run.num_runs
    if name not in _GREEDY:
        return []
    values = GoalValues(
        agent.loss,
        agent.actor,
        runs=runs,
        before_actor=None if state is None else ZeroPad(state.curriculum, at_the_top(state.curriculum, runs)),
        before_critic=agent.norm,
    )
    if name == "mega":
        return [InverseDensity(), ValueCutoff(values, runs=runs, **_cutoff(recipe, rewards))]
    several = getattr(recipe.learner, "critics", 1) > 1  # their disagreement shows what is new
    return [*([] if several else [InverseDensity()]), DiscoverScore(values, runs=runs)]


def _cutoff(recipe: Recipe, rewards: tuple[float, float]) -> dict[str, float]:
    """The cut-off of values, which the recipe gives for rewards of -1 and 0, for the rewards of the task."""
    (missed, achieved), gamma = rewards, recipe.learner.gamma

    def value(cutoff: float) -> float:
        reached = min(1.0, max(0.0, 1.0 + cutoff * (1.0 - gamma)))  # gamma^d of a goal that takes d steps
        return missed * (1.0 - reached) / (1.0 - gamma) + achieved * reached

    first = value(recipe.behavior.cutoff)
    floor = value(-1.0 / (1.0 - gamma))
    return {"cutoff": first, "floor": floor, "step": abs(value(-1.0) - value(0.0))}
