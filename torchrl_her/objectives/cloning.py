"""Behavior cloning: what pulls a policy to the actions of demonstrations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import LossModule

from torchrl_her.objectives.critics import critic_value

DEMONSTRATION = "demonstration"  # the flag of rows that are demonstrations


@dataclass(frozen=True, kw_only=True)
class Cloning:
    """How a loss clones the behavior of demonstrations.

    Args:
        weight: of the cloning loss, which is added to the actor's, at least 0.
        q_filter: whether only those actions are cloned that the critic prefers to the policy's.
        key: of the flag [..., 1] of bool that marks rows of demonstrations.

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
    """The terms of the cloning loss: their sum over a batch is the mean over the demonstrations in it.

    A term is ``||action - demonstrated||^2 / D`` for D demonstrations among B rows; 0 for other rows, and for
    demonstrations that the Q filter drops. Nair et al., Overcoming exploration in reinforcement learning with
    demonstrations, 2018 (arXiv 1709.10089), equations 2 and 3.

    Args:
        action: [..., B, a], of the policy.
        demonstrated: [..., B, a].
        flagged: [..., B] of bool, which rows are demonstrations.

    Keyword Args:
        better: [..., B] of bool, whether the critic prefers the demonstrated action; None for no Q filter.

    Returns:
        [..., B]

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


class ClonesDemonstrations:
    """Adds behavior cloning to the actor's loss; a base class in front of one of TorchRL's losses.

    The subclass calls :meth:`with_cloning` where the actor's loss is computed. For stochastic policies the
    action is the greedy one.

    Args:
        *args: of the loss.
        cloning: its weight and filter.
        **kwargs: of the loss.
    """

    actor_network: Any
    actor_network_params: Any
    tensor_keys: Any

    def __init__(self, *args: Any, cloning: Cloning, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.cloning = cloning

    def with_cloning(self, loss: Tensor, tensordict: TensorDictBase) -> Tensor:
        """The actor's loss and the cloning loss.

        Args:
            loss: of the actor: the mean over all rows, or one number for each.
            tensordict: rows [..., B]; each block of B is averaged by itself.

        Raises:
            KeyError: rows have no flag.
            ValueError: the loss has no critics for the Q filter.
        """
        flag = tensordict.get(self.cloning.key, None)
        if flag is None:
            raise KeyError(
                f"behavior cloning needs the flag {self.cloning.key!r} in each row, as MixedReplay gives it, "
                f"got {list(tensordict.keys())}"
            )
        flagged = flag.reshape(tensordict.shape)
        batch = flagged.shape[-1]
        at = flagged.reshape(-1, batch).any(0).nonzero().squeeze(-1)  # no other rows count
        if len(at) == 0:
            return loss
        key = self._action_key
        rows = tensordict.select(*self.actor_network.in_keys, key)[..., at]
        shown = rows.get(key)
        with (
            set_exploration_type(ExplorationType.DETERMINISTIC),
            self.actor_network_params.to_module(self.actor_network, preserve_module_state=False),
        ):
            action = self.actor_network(rows.copy()).get(key)
        better = None
        if self.cloning.q_filter:
            better = self._prefers(rows, shown, action.detach())
        terms = self.cloning.weight * cloning_terms(action, shown, flagged[..., at], better=better)
        if loss.ndim == 0:
            return loss + terms.sum(-1).mean()
        return loss + torch.zeros_like(loss).index_copy(-1, at, batch * terms)

    @property
    def _action_key(self) -> Any:
        """DDPG's loss has no name for it, but its actor has."""
        return getattr(self.tensor_keys, "action", self.actor_network.out_keys[0])

    def _prefers(self, rows: TensorDictBase, one: Tensor, other: Tensor) -> Tensor:
        """Whether the loss's critics value one action [..., b, a] higher than another: [..., b] of bool."""
        key = self._action_key
        both = torch.cat([rows.copy().set(key, action) for action in (one, other)], -1)  # one call is faster
        value = critic_value(cast(LossModule, self), both)
        if value is None:
            raise ValueError(f"a {type(self).__name__} has no critics for the Q filter: q_filter=False")
        first, second = value.squeeze(-1).chunk(2, -1)
        return first > second


def cloning_or(plain: type, clones: type, cloning: Cloning | None) -> tuple[Any, dict[str, Any]]:
    """Which of two losses to make, and its further options."""
    return (plain, {}) if cloning is None else (clones, {"cloning": cloning})
