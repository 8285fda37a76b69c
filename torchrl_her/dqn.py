"""DQN from TorchRL's loss, for a finite number of actions: network, policy and loss."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from tensordict import NestedKey
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import Categorical
from torchrl.modules import QValueActor
from torchrl.objectives import DQNLoss

from torchrl_her.losses import clamped_td0
from torchrl_her.networks import StackedLinear, by_run, hidden_layer


class QNet(nn.Module):
    """(observation, goal) to the values of all actions.

    Args:
        inputs: width of all inputs together.
        actions: how many actions there are.
        hidden: width of each of the three hidden layers.
        runs: R, how many independent networks.

    Example:
        >>> QNet(6, 4)(torch.zeros(2, 3), torch.zeros(2, 3)).shape
        torch.Size([2, 4])
    """

    def __init__(self, inputs: int, actions: int, *, hidden: int = 64, runs: int = 1) -> None:
        super().__init__()
        self.runs = runs
        widths = [inputs, hidden, hidden, hidden]
        layers = [hidden_layer(widths[i], widths[i + 1], runs=runs) for i in range(3)]
        self.layers = nn.Sequential(*layers, StackedLinear(hidden, actions, runs=runs))

    def forward(self, *inputs: Tensor) -> Tensor:
        """[..., widths] of the inputs to [..., actions]."""
        x = torch.cat(inputs, -1)
        return self.layers(by_run(x, self.runs)).view(*x.shape[:-1], -1)


class _ChosenValue(nn.Module):
    """(observation, goal, action) to the action's value [..., 1]."""

    def __init__(self, net: QNet) -> None:
        super().__init__()
        self.net = net

    def forward(self, *inputs: Tensor) -> Tensor:
        *seen, action = inputs
        return self.net(*seen).gather(-1, action.unsqueeze(-1))


def make_q_actor(
    widths: Sequence[int],
    actions: int,
    *,
    hidden: int = 64,
    runs: int = 1,
    in_keys: Sequence[NestedKey] = ("observation", "desired_goal"),
    value: NestedKey = "state_action_value",
) -> tuple[QValueActor, TensorDictModule]:
    """The greedy policy over the values of a :class:`QNet`, and the value of a given action by it.

    Args:
        widths: of the inputs, one for each of ``in_keys``.
        actions: how many actions there are; they are whole numbers (``Categorical``).
        hidden: width of the hidden layers.
        runs: R, how many independent networks.
        in_keys: what it sees; the goal must be among them.
        value: where the value of a given action is written.

    Returns:
        The actor, and the critic, which share their weights.

    Example:
        >>> from tensordict import TensorDict
        >>> actor, critic = make_q_actor((3, 3), 4)
        >>> seen = TensorDict({"observation": torch.zeros(2, 3), "desired_goal": torch.ones(2, 3)}, [2])
        >>> critic(actor(seen))["state_action_value"].shape
        torch.Size([2, 1])
    """
    net = QNet(sum(widths), actions, hidden=hidden, runs=runs)
    actor = QValueActor(net, spec=Categorical(actions), in_keys=list(in_keys), action_space="categorical")
    return actor, TensorDictModule(_ChosenValue(net), in_keys=[*in_keys, "action"], out_keys=[value])


def make_dqn_loss(
    actor: QValueActor,
    *,
    gamma: float = 0.98,
    reward_range: tuple[float, float] = (-1.0, 0.0),
    double: bool = True,
    reduction: Literal["mean", "none"] = "mean",
) -> DQNLoss:
    """TorchRL's (double) DQN loss with a target network and clamped targets.

    Args:
        actor: from :func:`make_q_actor`.
        gamma: discount, in [0, 1).
        reward_range: least and greatest reward; targets are clamped to what these allow.
        double: whether the online network chooses the next action (van Hasselt et al., 2016).
        reduction: ``"none"`` keeps the losses of rows [R, B] apart, for stacked networks.

    Raises:
        ValueError: a discount outside of [0, 1).

    Example:
        >>> loss = make_dqn_loss(make_q_actor((3, 3), 4)[0])
        >>> round(loss.value_estimator.low), round(loss.value_estimator.high)
        (-50, 0)
    """
    loss = DQNLoss(actor, delay_value=True, double_dqn=double, reduction=reduction)
    estimator = clamped_td0(gamma, reward_range, loss.value_network)
    estimator.set_keys(value="chosen_action_value")
    loss.make_value_estimator(estimator)
    return loss
