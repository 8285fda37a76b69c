"""Actor and critic of appendix B: three hidden layers, the action joined behind the critic's first."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

_LAST_LAYER = 3e-3  # small last layers keep early actions off the ends of tanh: Lillicrap et al., 2016


def _layer(inputs: int, outputs: int, *, normalise: bool) -> nn.Sequential:
    norm = [nn.BatchNorm1d(outputs)] if normalise else []
    return nn.Sequential(nn.Linear(inputs, outputs), *norm, nn.ReLU())


def _last_layer(inputs: int, outputs: int) -> nn.Linear:
    layer = nn.Linear(inputs, outputs)
    nn.init.uniform_(layer.weight, -_LAST_LAYER, _LAST_LAYER)
    nn.init.uniform_(layer.bias, -_LAST_LAYER, _LAST_LAYER)
    return layer


class ActorNet(nn.Module):
    """(observation, goal) to an action in [-1, 1].

    Args:
        inputs: width of all inputs together.
        actions: width of the action.
        hidden: width of each of the three hidden layers.

    Example:
        >>> ActorNet(11, 3)(torch.zeros(2, 9), torch.zeros(2, 2)).shape
        torch.Size([2, 3])
    """

    def __init__(self, inputs: int, actions: int, *, hidden: int = 64) -> None:
        super().__init__()
        widths = [inputs, hidden, hidden, hidden]
        layers = [_layer(widths[i], widths[i + 1], normalise=False) for i in range(3)]
        self.layers = nn.Sequential(*layers, _last_layer(hidden, actions), nn.Tanh())

    def forward(self, *inputs: Tensor) -> Tensor:
        """[..., widths] of the inputs to [..., actions]."""
        return self.layers(torch.cat(inputs, -1))


class CriticNet(nn.Module):
    """(observation, goal, action) to the action's value.

    Args:
        inputs: width of all inputs but the action together.
        actions: width of the action, the last input.
        hidden: width of each of the three hidden layers.
        normalise: batch normalisation of the input and of the hidden layers.

    Example:
        >>> CriticNet(11, 3)(torch.zeros(2, 9), torch.zeros(2, 2), torch.zeros(2, 3)).shape
        torch.Size([2, 1])
    """

    def __init__(self, inputs: int, actions: int, *, hidden: int = 64, normalise: bool = False) -> None:
        super().__init__()
        norm = [nn.BatchNorm1d(inputs)] if normalise else []
        self.first = nn.Sequential(*norm, _layer(inputs, hidden, normalise=normalise))
        self.rest = nn.Sequential(
            _layer(hidden + actions, hidden, normalise=normalise),
            _layer(hidden, hidden, normalise=normalise),
            _last_layer(hidden, 1),
        )

    def forward(self, *inputs: Tensor) -> Tensor:
        """[..., widths] of the inputs, the action last, to [..., 1]."""
        *seen, action = inputs
        return self.rest(torch.cat((self.first(torch.cat(seen, -1)), action), -1))


def make_actor(
    widths: Sequence[int],
    actions: int,
    *,
    hidden: int = 64,
    in_keys: Sequence[NestedKey] = ("observation", "desired_goal"),
    action: NestedKey = "action",
) -> TensorDictModule:
    """The actor as a TensorDict module.

    Args:
        widths: of the inputs, one for each of ``in_keys``.
        actions: width of the action, which is within [-1, 1].
        hidden: width of the hidden layers.
        in_keys: what it sees; the goal must be among them.
        action: where it writes.

    Example:
        >>> from tensordict import TensorDict
        >>> actor = make_actor((9, 2), 3)
        >>> actor(TensorDict({"observation": torch.zeros(4, 9), "desired_goal": torch.zeros(4, 2)}, [4]))["action"].shape
        torch.Size([4, 3])
    """
    return TensorDictModule(ActorNet(sum(widths), actions, hidden=hidden), in_keys=list(in_keys), out_keys=[action])


def make_critic(
    widths: Sequence[int],
    actions: int,
    *,
    hidden: int = 64,
    normalise: bool = False,
    in_keys: Sequence[NestedKey] = ("observation", "desired_goal"),
    action: NestedKey = "action",
    value: NestedKey = "state_action_value",
) -> TensorDictModule:
    """The critic as a TensorDict module; arguments as of :func:`make_actor` and :class:`CriticNet`."""
    net = CriticNet(sum(widths), actions, hidden=hidden, normalise=normalise)
    return TensorDictModule(net, in_keys=[*in_keys, action], out_keys=[value])
