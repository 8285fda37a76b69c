"""Measures the success of runs in their stages of a curriculum, and moves runs to the next stage."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_her.curriculum.normalization import restart_inputs
from torchrl_her.curriculum.switch import enter_stage
from torchrl_her.goals.rewards import EnvReward
from torchrl_her.trainers.metrics import at_the_end, success
from torchrl_her_envs.common.goal_env import goal_env
from torchrl_her_recipes.components.assembly import eval_seeds
from torchrl_her_recipes.components.components import Components
from torchrl_her_recipes.components.curricula import CurriculumState
from torchrl_her_recipes.components.envs import play_episodes


def play_greedily(components: Components, env: EnvBase, epoch: int) -> TensorDictBase:
    """Plays greedy episodes of all runs, with starts and goals that are new in each epoch."""
    recipe = components.recipe
    goal_env(env).set_seeds(eval_seeds(recipe.seeds, epoch))
    return play_episodes(env, components.player, recipe.evaluation.episodes, runs=recipe.run.num_runs)


def stage_success(
    components: Components, state: CurriculumState, rollout: TensorDictBase, epoch: int
) -> Tensor:
    """Returns success [R, n] at goals of each run's stage; ``rollout`` has episodes of the full task."""
    runs, last = components.recipe.run.num_runs, len(state.curriculum) - 1
    full = success(rollout, EnvReward.of(components.eval_env)).float().view(runs, -1)
    below = state.progress.stage < last
    if state.stage_env is None or not bool(below.any()):
        return full
    played = play_greedily(components, state.stage_env, epoch)
    met = played["next", "reward"].squeeze(-1) >= components.rewards[1]  # of the stage's goal
    in_stage = at_the_end(played, met).float().view(runs, -1)
    return torch.where(below.unsqueeze(1), in_stage, full)


def move_on(components: Components, state: CurriculumState, samples: Tensor, frames: int) -> list[str]:
    """Moves runs to the next stage if ``samples`` [R, n] of success end their stage; returns messages."""
    before, evaluations = state.progress.stages, state.progress.evaluations
    # Records at most ``window`` samples: more samples of one evaluation make a lucky streak more likely.
    moved = state.progress.record(samples[:, : state.progress.window])
    learner, exploration, lines = components.recipe.learner, components.exploration, []
    for run in moved.nonzero().flatten().tolist():
        old, new = state.curriculum.stages[before[run]], state.progress.stage_of(run)
        seed = components.recipe.seeds[run]
        learned = "learned" if evaluations[run] + 1 != state.progress.patience else "ended without success"
        lines.append(f"seed {seed}: {old.name!r} {learned} after {frames:,} frames, {new.name!r} begins")
        if components.guide is not None:
            components.guide.follow(components.greedy, before[run], run=run)
        enter_stage(
            components.buffer,
            new,
            exploration if learner.has_epsilon else None,
            epsilon=getattr(components.recipe.order, "stage_epsilon", 1.0),
            run=run,
        )
        if components.behavior is not None:
            components.behavior.set_active(state.at_the_top(run), run=run)
        if components.norm is not None:
            restart_inputs(components.norm, old, new, run=run)
        if components.demonstrations is not None:
            components.demonstrations.enter_stage(run)
    return lines
