"""Networks for the values of discrete actions, and the greedy policy."""

from __future__ import annotations

from collections.abc import Sequence

from tensordict import NestedKey
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import Categorical
from torchrl.modules import QValueActor

from torchrl_her.modules.networks import GoalNet, NetworkShape


class QNet(GoalNet):
    """:class:`~torchrl_her.modules.GoalNet` that maps (observation, goal) to the values of all actions.

    Example:
        >>> import torch
        >>> QNet(6, 4)(torch.zeros(2, 3), torch.zeros(2, 3)).shape
        torch.Size([2, 4])
    """


class BestAction(nn.Module):
    """Greedy policy: maps (observation, goal) to the action of the greatest value.

    Args:
        net: network that gives the values; other modules may share it.

    Example:
        >>> import torch
        >>> best = BestAction(QNet(6, 4))
        >>> best(torch.zeros(2, 3), torch.zeros(2, 3)).dtype
        torch.int64
    """

    def __init__(self, net: QNet) -> None:
        super().__init__()
        self.net = net

    def forward(self, *inputs: Tensor) -> Tensor:
        """Maps inputs [..., width] to integers [...]."""
        return self.net(*inputs).argmax(-1)

    def regret(self, action: Tensor, *inputs: Tensor) -> Tensor:
        """Returns how far the values of actions [...] are below the greatest values of their rows.

        Example:
            >>> import torch
            >>> best, seen = BestAction(QNet(6, 4)), (torch.zeros(2, 3), torch.zeros(2, 3))
            >>> best.regret(best(*seen), *seen).tolist()
            [0.0, 0.0]
        """
        values = self.net(*inputs)
        return values.amax(-1) - values.gather(-1, action.unsqueeze(-1)).squeeze(-1)


class _ChosenValue(nn.Module):
    """Critic that maps (observation, goal, action) to the action's value [..., 1]."""

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
    shape: NetworkShape = NetworkShape(),
    runs: int = 1,
    in_keys: Sequence[NestedKey] = ("observation", "desired_goal"),
    value_key: NestedKey = "state_action_value",
) -> tuple[QValueActor, TensorDictModule]:
    """Makes a policy that is greedy in the values of a :class:`~torchrl_her.modules.QNet`, and its critic.

    Args:
        widths: widths of the inputs, one for each of ``in_keys``.
        actions: number of actions; they are integers (``Categorical``).
        shape: shape of the hidden layers.
        runs: R, how many independent networks.
        in_keys: keys of the inputs; the goal must be among them.
        value_key: key under which the value of a given action is written.

    Returns:
        ``(actor, critic)``, which share their weights; the critic computes the value of a given action.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> actor, critic = make_q_actor((3, 3), 4)
        >>> seen = TensorDict({"observation": torch.zeros(2, 3), "desired_goal": torch.ones(2, 3)}, [2])
        >>> critic(actor(seen))["state_action_value"].shape
        torch.Size([2, 1])
    """
    net = QNet(sum(widths), actions, shape=shape, runs=runs)
    actor = QValueActor(net, spec=Categorical(actions), in_keys=list(in_keys), action_space="categorical")
    return actor, TensorDictModule(_ChosenValue(net), in_keys=[*in_keys, "action"], out_keys=[value_key])
