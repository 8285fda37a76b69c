"""Runs on their way through a curriculum: what they show of their layer, and what follows from it."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_her import enter_layer, evaluate, success
from torchrl_her_envs import goal_env
from torchrl_her_recipes.curricula import Climb
from torchrl_her_recipes.parts import Parts, eval_seeds


def play_greedily(parts: Parts, env: EnvBase, epoch: int) -> TensorDictBase:
    """Greedy episodes of each run, with starts and goals of their own in each epoch."""
    task = goal_env(env)
    task.set_seeds(eval_seeds(parts.recipe, epoch))
    return evaluate(env, parts.policy, max_steps=task.max_steps)


def layer_success(parts: Parts, climb: Climb, rollout: TensorDictBase, epoch: int) -> Tensor:
    """Success [R, n] at the goals of the runs' layers; that of ``rollout`` where it is the full task."""
    runs, last = parts.recipe.num_runs, len(climb.curriculum) - 1
    full = success(rollout).float().view(runs, -1)
    below = climb.progress.layer < last
    if not bool(below.any()):
        return full
    own = success(play_greedily(parts, climb.layer_env, epoch)).float().view(runs, -1)
    return torch.where(below.unsqueeze(1), own, full)


def move_on(parts: Parts, climb: Climb, samples: Tensor, frames: int) -> list[str]:
    """Lets runs that have learnt their layer begin the next one; a line for people for each of them."""
    before = climb.progress.layers
    # As many as the window takes: more in one evaluation would give a lucky streak many chances.
    moved = climb.progress.record(samples[:, : climb.progress.window])
    lines = []
    for run in moved.nonzero().flatten().tolist():
        old, new = climb.curriculum.layers[before[run]], climb.progress.layer_of(run)
        seed = parts.recipe.seeds[run]
        lines.append(f"seed {seed}: {old.name!r} learnt after {frames:,} frames, {new.name!r} begins")
        enter_layer(parts.buffers[run], new, parts.exploration, epsilon=parts.recipe.layer_epsilon, run=run)
    return lines
