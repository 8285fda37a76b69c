"""Makes the transforms that propose goals of training episodes, for :mod:`...config.choices.behavior`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from torchrl.envs import EnvBase

from torchrl_her.behavior import (
    BehaviorGoals,
    DiscoverScore,
    GoalProposal,
    GoalValues,
    InverseDensity,
    ValueCutoff,
)
from torchrl_her.curriculum.transforms import ZeroPad
from torchrl_her.goals.rewards import EnvReward
from torchrl_her_envs.common.goal_env import goal_env, reward_range
from torchrl_her_recipes.components.curricula import CurriculumState, at_the_top
from torchrl_her_recipes.components.goals.space import GoalSpace, KernelSpace
from torchrl_her_recipes.components.goals.weights import make_instructive
from torchrl_her_recipes.components.learner import Agent
from torchrl_her_recipes.components.streams import Stream, generators_of
from torchrl_her_recipes.config.choices.behavior import IBS, Behavior, Discover, Mega, Proposed
from torchrl_her_recipes.config.choices.learners import LearnerConfig
from torchrl_her_recipes.config.values import load_name

MakeValues = Callable[[], GoalValues]


def make_behavior(
    options: Behavior,
    learner: LearnerConfig,
    env: EnvBase,
    agent: Agent,
    *,
    seeds: Sequence[int],
    space: GoalSpace | KernelSpace | None,
    state: CurriculumState | None,
) -> BehaviorGoals | None:
    """Makes the transform that proposes goals; returns None if episodes have only the task's goals."""
    if not isinstance(options, Proposed):
        return None
    runs, rewards = len(seeds), reward_range(goal_env(env))
    keywords: dict[str, Any] = {"real_share": options.real_share, "memory": options.goal_memory}
    if state is not None and state.progress.by_episode:
        keywords |= {"stage_key": "stage", "stage": len(state.curriculum) - 1}
    pad = None if state is None else ZeroPad(state.curriculum, at_the_top(state.curriculum, runs))
    values = partial(
        GoalValues, agent.loss, agent.actor, runs=runs, before_actor=pad, before_critic=agent.norm
    )
    proposal = load_name(options.maker)(
        options, learner=learner, runs=runs, rewards=rewards, space=space, values=values
    )
    behavior = _goals(seeds, env, proposal=proposal, **keywords)
    if state is not None:
        for run in range(runs):
            behavior.set_active(state.at_the_top(run), run=run)
    return behavior


def make_asking(seeds: Sequence[int], env: EnvBase, *, memory: int) -> BehaviorGoals:
    """Makes a transform for evaluation: episodes get goals that the caller has put into its memory."""
    return _goals(
        seeds, env, proposal=GoalProposal(candidates=1), remember=False, real_share=0.0, memory=memory
    )


def _goals(seeds: Sequence[int], env: EnvBase, **options: Any) -> BehaviorGoals:
    return BehaviorGoals(
        EnvReward.of(env),
        runs=len(seeds),
        generators=generators_of(seeds, Stream.PROPOSED_GOALS),
        continues_after_termination=goal_env(env).continues_after_termination,
        **options,
    )


def make_uniform(_options: Proposed, **_: Any) -> GoalProposal:
    """Makes a proposal of any achieved goal, with equal probability."""
    return GoalProposal()


def make_ibs(options: IBS, *, runs: int, space: Any, **_: Any) -> GoalProposal:
    """Makes a proposal of goals in proportion to q* (share in the task) - q (share so far)."""
    weights = [make_instructive(options, space=space) for _ in range(runs)]
    return GoalProposal(weights=weights, update_on="proposed", candidates=options.candidates)


def make_mega(
    options: Mega, *, learner: LearnerConfig, runs: int, rewards: Any, values: MakeValues, **_: Any
) -> GoalProposal:
    """Makes a proposal of the rarest achieved goal whose value exceeds a cutoff."""
    cutoffs = scaled_cutoffs(options.cutoff, learner.gamma, rewards)
    factors = [InverseDensity(), ValueCutoff(values(), runs=runs, **cutoffs)]
    return GoalProposal(factors=factors, greedy=True, candidates=options.candidates)


def scaled_cutoffs(cutoff: float, gamma: float, rewards: tuple[float, float]) -> dict[str, float]:
    """Converts a cutoff for rewards of -1 and 0 to arguments of ``ValueCutoff`` for the task's rewards."""
    missed, achieved = rewards

    def value(cutoff: float) -> float:
        reached = min(1.0, max(0.0, 1.0 + cutoff * (1.0 - gamma)))  # gamma^d, if the goal is d steps away
        return missed * (1.0 - reached) / (1.0 - gamma) + achieved * reached

    floor, step = value(-1.0 / (1.0 - gamma)), abs(value(-1.0) - value(0.0))
    return {"cutoff": value(cutoff), "floor": floor, "step": step}


def make_discover(
    options: Discover, *, learner: LearnerConfig, runs: int, values: MakeValues, **_: Any
) -> GoalProposal:
    """Makes a proposal of new, achievable goals that lead toward the task's goal (DISCOVER)."""
    several = getattr(learner, "critics", 1) > 1  # a goal is new if critics disagree on its value
    score = DiscoverScore(values(), runs=runs)
    factors = [score] if several else [InverseDensity(), score]
    return GoalProposal(factors=factors, greedy=True, candidates=options.candidates)
