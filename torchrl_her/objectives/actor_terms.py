"""Terms of an actor's loss besides the values of its actions: costs of actions, and behavior cloning."""

from __future__ import annotations

from dataclasses import dataclass

from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives import LossModule

from torchrl_her.objectives.cloning import Cloning, with_cloning

FREE_ARGUMENT = 2.0  # arguments of tanh up to 2 have no penalty: tanh(2) is 0.964, with a slope of 0.07
LARGEST_ACTION = 1 - 1e-6  # nearer to 1, arguments of tanh are lost to float32's rounding


def action_cost(action: Tensor, *, l2: float = 0.0, saturation: float = 0.0) -> Tensor:
    """Cost of actions in an actor's loss: their mean square, and how far they are saturated.

    An actor that ends in tanh gets no gradient where its actions are at their bounds. The action L2 penalty
    of OpenAI's HER prevents that by pulling all actions towards 0. But as long as the critic gives all
    actions about the same value, the actor then learns to stand still. The saturation penalty acts only
    where ``|atanh(action)|`` is above 2, with a slope that tanh does not flatten.

    Args:
        action: [..., a], from -1 to 1.
        l2: weight of the mean square of an action.
        saturation: weight of the mean of ``max(|atanh(action)| - 2, 0) ** 2``.

    Returns:
        Costs [...].

    Example:
        >>> import torch
        >>> action_cost(torch.tensor([1.0, 0.0]), l2=0.5).item()
        0.25
        >>> cost = action_cost(torch.tensor([3.0, -1.0]).tanh(), saturation=0.5)  # 0.5 * (1 + 0) / 2
        >>> round(cost.item(), 4)
        0.25
    """
    cost = l2 * action.square().mean(-1)
    if saturation:
        argument = action.clamp(-LARGEST_ACTION, LARGEST_ACTION).atanh()
        cost = cost + saturation * (argument.abs() - FREE_ARGUMENT).clamp(min=0).square().mean(-1)
    return cost


@dataclass(frozen=True, kw_only=True)
class ActorTerms:
    """Terms that are added to an actor's loss: penalties on its actions, and behavior cloning.

    Args:
        action_penalty: weight of the action L2 penalty, see :func:`~torchrl_her.objectives.action_cost`.
        saturation_penalty: weight of the saturation penalty, which is for deterministic actors.
        cloning: options for cloning the actions of rows marked as demonstrations; None for no cloning.
    """

    action_penalty: float = 0.0
    saturation_penalty: float = 0.0
    cloning: Cloning | None = None

    def add_to(self, value: Tensor, loss: LossModule, action: Tensor, transitions: TensorDictBase) -> Tensor:
        """Adds the terms to the loss of an actor.

        Args:
            value: the actor's loss: the mean over all rows, or one number for each row.
            loss: TorchRL loss that has the actor.
            action: [..., a], the actor's actions, from -1 to 1.
            transitions: [...], the transitions of the batch.
        """
        cost = action_cost(action, l2=self.action_penalty, saturation=self.saturation_penalty)
        value = value + (cost if value.ndim else cost.mean())
        return value if self.cloning is None else with_cloning(value, loss, self.cloning, transitions)
