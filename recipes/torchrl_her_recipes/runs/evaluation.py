"""Computes the metrics of runs at the end of an epoch."""

from __future__ import annotations

import math
from dataclasses import asdict

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_her.goals.ibs import GoalHistogram
from torchrl_her.goals.instructive import InstructiveWeights
from torchrl_her.goals.rewards import EnvReward
from torchrl_her.objectives.critics import critic_value
from torchrl_her.trainers.metrics import discounted_return, final_distance, q_bias, reached, success
from torchrl_her_recipes.components.components import Components
from torchrl_her_recipes.components.devices import place_of
from torchrl_her_recipes.runs.notices import saturation


@torch.no_grad()
def measure(components: Components, rollout: TensorDictBase) -> dict[str, Tensor]:
    """Computes metrics of policy and critics from greedy episodes; each metric has a value per run, [R].

    ``q`` is the value that the critics in the loss give to the first action, see
    :func:`~torchrl_her.objectives.critic_value`. ``q_bias`` is ``q`` minus the discounted return of the
    episode. Both are missing if the loss has no critics with a value of one number.
    """
    recipe, rule = components.recipe, EnvReward.of(components.eval_env)
    succeeded = success(rollout, rule)
    # After truncation, an episode is assumed to stay at its goal if it is there, and else never to reach it.
    missed, achieved = components.rewards
    tail = torch.where(succeeded, achieved, missed).to(rollout["next", "reward"].dtype)
    returns = discounted_return(rollout, recipe.learner.gamma, tail_reward=tail)
    measured = {
        "success": succeeded.float(),
        "reached": reached(rollout, rule).float(),
        "distance": final_distance(rollout),
        "return": returns,
    }
    if rollout["action"].is_floating_point():
        spec = components.env.action_spec_unbatched
        measured["saturation"] = saturation(rollout["action"], spec.low, spec.high).mean(1)
    start = rollout[:, 0].to(place_of(components.loss))
    value = critic_value(components.loss, start if components.norm is None else components.norm(start))
    if value is not None:
        value = value.to(returns.device)
        measured |= {"q": value.squeeze(-1), "q_bias": q_bias(value, returns)}
    return {name: value.view(recipe.run.num_runs, -1).mean(1) for name, value in measured.items()}


def written(components: Components, run: int) -> dict[str, float]:
    """Returns metrics of the rows that one run has written: counts, and the divergence ``kl`` of goals."""
    writer = components.buffer.writer
    counts = {f"rows_{name}": value for name, value in asdict(writer.totals_of(run)).items()}
    weights = writer.goal_weights[run] if writer.goal_weights else None
    divergence = None
    if isinstance(weights, GoalHistogram) and components.goal_target is not None:
        divergence = weights.divergence_to(components.goal_target)
    elif isinstance(weights, InstructiveWeights):
        divergence = weights.divergence
    if divergence is not None:
        # q* describes goals of the full task, with which goals of earlier stages cannot be compared.
        full = components.curriculum is None or components.curriculum.at_the_top(run)
        counts["kl"] = divergence if full else math.nan
    return counts
