"""The replay buffer of a run."""

from __future__ import annotations

import torch
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import PrioritizedSampler, RandomSampler, Sampler
from torchrl.envs import EnvBase

from torchrl_her.curriculum.switch import set_layer_goals
from torchrl_her.curriculum.transforms import ZeroPad
from torchrl_her.goals.rewards import EnvReward
from torchrl_her.replay_buffers.writer import HERWriter
from torchrl_her_envs.common.goal_env import goal_env
from torchrl_her_recipes.components.curricula import CurriculumState
from torchrl_her_recipes.components.goal_space import GoalSpace, make_goal_weights
from torchrl_her_recipes.config.algorithms import get_algorithm
from torchrl_her_recipes.config.learners import priority_power
from torchrl_her_recipes.config.recipe import Recipe

# Entries of a collected batch that no loss reads: not stored.
_NOT_STORED = ("state", "achieved_goal", "input", "collector")


def make_buffer(
    recipe: Recipe,
    env: EnvBase,
    generator: torch.Generator,
    *,
    rewards: tuple[float, float] = (-1.0, 0.0),
    space: GoalSpace | None = None,
    state: CurriculumState | None = None,
    run: int = 0,
) -> TensorDictReplayBuffer:
    """The replay buffer of one run, with its hindsight writer and its sampler."""
    algorithm, task = get_algorithm(recipe.hindsight.algo), goal_env(env)
    weights = make_goal_weights(recipe, task, space) if algorithm.hindsight else None
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(recipe.replay.buffer_size),
        writer=HERWriter(
            EnvReward(task.compute_reward, task.compute_terminated),
            k=recipe.hindsight.k if algorithm.hindsight else 0,
            strategy=recipe.hindsight.strategy,
            n_steps=recipe.hindsight.n_steps,
            gamma=recipe.learner.gamma,
            filter_achieved=algorithm.filter_achieved,
            achieved_reward=rewards[1],
            weights=weights,
            exclude=_NOT_STORED,
        ),
        sampler=_make_sampler(recipe),
        priority_key="td_error",
    )
    buffer.set_rng(generator)
    if state is not None:
        set_layer_goals(buffer.writer, state.progress.layer_of(run))
        buffer.append_transform(ZeroPad(state.curriculum, state.progress, run=run))
    return buffer


def _make_sampler(recipe: Recipe) -> Sampler:
    if recipe.replay.sampler == "uniform":
        return RandomSampler()
    # Alpha is Schaul's, for absolute TD errors; most of TorchRL's losses give their squares.
    alpha = recipe.replay.priority_alpha / priority_power(recipe.learner.name)
    return PrioritizedSampler(recipe.replay.buffer_size, alpha=alpha, beta=recipe.replay.priority_beta)
