"""What is measured of runs at the end of an epoch."""

from __future__ import annotations

import math
from dataclasses import asdict

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor

from torchrl_her import GoalHistogram, HERWriter, discounted_return, final_distance, q_bias, success
from torchrl_her_envs import goal_env
from torchrl_her_recipes.parts import Parts
from torchrl_her_recipes.small_world_values import measure_values

_SATURATED = 0.99


@torch.no_grad()
def measure(parts: Parts, rollout: TensorDictBase) -> dict[str, Tensor]:
    """What greedy episodes of each run show, [R] each."""
    recipe = parts.recipe
    missed, achieved = parts.rewards
    returns = discounted_return(rollout, recipe.gamma, tail_reward=missed)
    measured = {
        "success": success(rollout, achieved_reward=achieved).float(),
        "distance": final_distance(rollout),
        "return": returns,
    }
    if rollout["action"].is_floating_point():
        measured["saturation"] = (rollout["action"].abs() > _SATURATED).float().mean((1, 2))
    if parts.critic is not None:
        value = _initial_value(parts.actor, parts.critic, rollout[:, 0])
        measured |= {"q": value, "q_bias": q_bias(value, returns)}
    means = {name: value.view(recipe.num_runs, -1).mean(1) for name, value in measured.items()}
    if parts.climb is None:
        means |= measure_values(parts.actor, goal_env(parts.eval_env), recipe.num_runs)
    return means | {"epsilon": parts.exploration.epsilon}


def _initial_value(actor: TensorDictModule, critic: TensorDictModule, start: TensorDictBase) -> Tensor:
    """The critic's value [N] of first states [N]."""
    critic.eval()
    value = critic(actor(start.select(*actor.in_keys))).get(critic.out_keys[0])
    critic.train()
    return value.squeeze(-1)


def written(parts: Parts, run: int) -> dict[str, float]:
    """What the writer of one run has counted."""
    writer = parts.buffers[run].writer
    if not isinstance(writer, HERWriter):
        return {}
    counts = {f"rows_{name}": value for name, value in asdict(writer.totals).items()}
    if isinstance(writer.weights, GoalHistogram) and parts.goal_target is not None:
        # q* is that of the full task
        full = parts.climb is None or parts.climb.at_the_top(run)
        counts["kl"] = writer.weights.divergence_to(parts.goal_target) if full else math.nan
    return counts
