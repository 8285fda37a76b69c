"""Costs of actions that keep an actor away from the flat ends of tanh."""

from __future__ import annotations

from torch import Tensor

FREE_ARGUMENT = 2.0  # arguments of tanh up to this cost nothing: tanh(2) is 0.964, and its slope 0.07
LARGEST_ACTION = 1 - 1e-6  # beyond it float32 hardly tells arguments of tanh apart


def action_cost(action: Tensor, *, l2: float = 0.0, saturation: float = 0.0) -> Tensor:
    """Cost of actions in an actor's loss: their mean square, and how far they are saturated.

    An actor that ends in tanh gets no gradient where its actions are at their bounds. The action L2 penalty
    of OpenAI's HER prevents that by pulling all actions towards 0, but then an actor whose critic cannot tell
    actions apart yet learns to stand still. The saturation penalty acts on ``atanh(action)`` beyond 2 alone,
    where its slope is not flattened by tanh, and leaves all other actions free.

    Args:
        action: [..., a], from -1 to 1.
        l2: weight of the mean square of an action.
        saturation: weight of the mean of ``max(|atanh(action)| - 2, 0) ** 2``.

    Returns:
        [...].

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
