"""Values of actions in bit flipping and in the treasure hunt."""

from __future__ import annotations

from functools import singledispatch

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_her_envs.common.goal_env import GoalEnv
from torchrl_her_envs.toy.bit_flip import BitFlip
from torchrl_her_envs.toy.treasure_hunt import TreasureHunt
from torchrl_her_recipes.components.devices import place_of

STATES = 256  # for each number of wrong bits


@torch.no_grad()
def action_values(actor: TensorDictModuleBase, place: Tensor, goal: Tensor) -> Tensor:
    """The values [..., actions] of all actions in places [..., g] when goals [..., g] are desired."""
    seen = TensorDict({"observation": place, "desired_goal": goal}, place.shape[:-1])
    return actor(seen.to(place_of(actor)))["action_value"].to(place.device)


def some_wrong(
    bits: int, wrong: int, states: int, generator: torch.Generator | None = None
) -> tuple[Tensor, Tensor]:
    """Random places [states, bits] that differ from their goals in ``wrong`` bits, and these goals."""
    place = torch.randint(2, (states, bits), generator=generator).float()
    differs = torch.rand(states, bits, generator=generator).argsort(-1) < wrong
    return place, torch.where(differs, 1.0 - place, place)


def measure_values(actor: TensorDictModuleBase, env: GoalEnv, runs: int) -> dict[str, Tensor]:
    """What the values of R runs are worth, where that can be said; [R] each.

    Args:
        actor: of DQN, of all runs.
        env: its task.
        runs: R.

    Returns:
        In bit flipping with a useless action, over 1 to n wrong bits alike: ``useless_share``, how often
        that action is the best one; ``useless_margin``, its value minus the mean of needed flips. In the
        treasure hunt: ``right_way``, the share of pairs of place and treasure whose best action goes towards
        the treasure. Nothing elsewhere.
    """
    return _measure(env, actor, runs)


@singledispatch
def _measure(_env: GoalEnv, _actor: TensorDictModuleBase, _runs: int) -> dict[str, Tensor]:
    """Another environment takes part by a function that is registered for its class."""
    return {}


@_measure.register
def _measure_useless(env: BitFlip, actor: TensorDictModuleBase, runs: int) -> dict[str, Tensor]:
    if not env.useless_action:
        return {}
    bits = env.bits
    generator = torch.Generator().manual_seed(0)
    each = [some_wrong(bits, wrong, STATES, generator) for wrong in range(1, bits + 1)]
    place, goal = (torch.cat(own) for own in zip(*each, strict=True))
    values = action_values(actor, place.repeat(runs, 1), goal.repeat(runs, 1)).view(runs, len(place), -1)
    needed = (place != goal).float()
    flips, useless = values[..., :bits], values[..., bits]
    margin = useless - (flips * needed).sum(-1) / needed.sum(-1)
    return {
        "useless_share": (values.argmax(-1) == bits).float().mean(1),
        "useless_margin": margin.mean(1),
    }


@_measure.register
def _right_way(env: TreasureHunt, actor: TensorDictModuleBase, runs: int) -> dict[str, Tensor]:
    place, goal = (points.reshape(-1, 1) for points in all_pairs(env))
    apart = (place != goal).squeeze(-1)
    place, goal = place[apart], goal[apart]
    values = action_values(actor, place.repeat(runs, 1), goal.repeat(runs, 1)).view(runs, len(place), 2)
    right = values.argmax(-1) == (goal > place).squeeze(-1).long()
    return {"right_way": right.float().mean(1)}


def all_pairs(env: TreasureHunt) -> tuple[Tensor, Tensor]:
    """All places along the first dimension, all treasures along the second: [places, treasures, 1] both."""
    goals = env.goal_distribution
    points = goals.from_uniform((torch.arange(goals.count)[:, None] + 0.5) / goals.count).float()
    count = len(points)
    return points[:, None].expand(count, count, 1), points[None].expand(count, count, 1)
