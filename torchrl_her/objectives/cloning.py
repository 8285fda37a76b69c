"""Behavior cloning: a loss that pulls a policy to the actions of demonstrations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_her.objectives.critics import action_key, critic_value

DEMONSTRATION = "demonstration"  # the flag of rows that are demonstrations


@dataclass(frozen=True, kw_only=True)
class Cloning:
    """Options for cloning the behavior of demonstrations in a loss.

    Args:
        weight: weight of the cloning loss, which is added to the actor's, at least 0.
        q_filter: whether to clone only actions that the critic prefers to the policy's.
        key: key of the bool flag [..., 1] that marks rows of demonstrations.

    Raises:
        ValueError: the weight is negative.
    """

    weight: float = 1.0
    q_filter: bool = True
    key: str = DEMONSTRATION

    def __post_init__(self) -> None:
        if not 0 <= self.weight < torch.inf:
            raise ValueError(
                f"the weight of behavior cloning must be at least 0 and finite, got {self.weight}"
            )


def cloning_terms(
    action: Tensor, demonstrated: Tensor, flagged: Tensor, *, better: Tensor | None = None
) -> Tensor:
    """Returns the terms of the cloning loss, whose sum over a batch is the mean over its demonstrations.

    A term is ``||action - demonstrated||^2 / D`` for D demonstrations among B rows; 0 for other rows, and for
    demonstrations that the Q filter drops. Nair et al., Overcoming exploration in reinforcement learning with
    demonstrations, 2018 (arXiv 1709.10089), equations 2 and 3.

    Args:
        action: [..., B, a], actions of the policy.
        demonstrated: [..., B, a], actions of the demonstrations.
        flagged: [..., B], mask of the rows that are demonstrations.

    Keyword Args:
        better: [..., B], mask of the rows whose demonstrated action the critic prefers; None for no Q filter.

    Returns:
        Terms [..., B].

    Example:
        >>> policy, shown = torch.zeros(4, 1), torch.tensor([[1.0], [2.0], [3.0], [9.0]])
        >>> flagged = torch.tensor([True, True, False, False])
        >>> cloning_terms(policy, shown, flagged).tolist()
        [0.5, 2.0, 0.0, 0.0]
        >>> cloning_terms(policy, shown, flagged, better=torch.tensor([False, True, True, True])).tolist()
        [0.0, 2.0, 0.0, 0.0]
    """
    squares = (action - demonstrated).square().sum(-1)
    counted = flagged if better is None else flagged & better
    return torch.where(counted, squares, 0.0) / flagged.sum(-1, keepdim=True).clamp(min=1)


def with_cloning(value: Tensor, loss: Any, cloning: Cloning, transitions: TensorDictBase) -> Tensor:
    """Adds the cloning loss to an actor's loss, which is a scalar or one number for each row [..., B].

    For stochastic policies the cloned action is the greedy one.
    """
    flag = transitions.get(cloning.key, None)
    if flag is None:
        raise KeyError(
            f"behavior cloning needs the flag {cloning.key!r} in each row, as MixedReplay gives it, "
            f"got {list(transitions.keys())}"
        )
    flagged = flag.reshape(transitions.shape)
    batch = flagged.shape[-1]
    at = flagged.reshape(-1, batch).any(0).nonzero().squeeze(-1)  # other rows have weight 0
    if len(at) == 0:
        return value
    key = action_key(loss)
    rows = transitions.select(*loss.actor_network.in_keys, key)[..., at]
    shown = rows.get(key)
    with (
        set_exploration_type(ExplorationType.DETERMINISTIC),
        loss.actor_network_params.to_module(loss.actor_network, preserve_module_state=False),
    ):
        action = loss.actor_network(rows.copy()).get(key)
    better = None
    if cloning.q_filter:
        both = [rows.copy().set(key, each) for each in (shown, action.detach())]
        q_values = critic_value(loss, torch.cat(both, -1))  # one call for both is faster
        if q_values is None:
            raise ValueError(f"a {type(loss).__name__} has no critics for the Q filter; set q_filter=False")
        of_shown, of_policy = q_values.squeeze(-1).chunk(2, -1)
        better = of_shown > of_policy
    terms = cloning.weight * cloning_terms(action, shown, flagged[..., at], better=better)
    if value.ndim == 0:
        return value + terms.sum(-1).mean()
    return value + torch.zeros_like(value).index_copy(-1, at, batch * terms)
