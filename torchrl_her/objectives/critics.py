"""Functions that pass critics to a loss of TorchRL, and that compute the values of its critics."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.objectives import DDPGLoss, DQNLoss, LossModule, TQCLoss

from torchrl_her.checks import check_whole
from torchrl_her.modules.networks import StackedBatchNorm
from torchrl_her.modules.noise import RunNoise


@torch.no_grad()
def critic_value(loss: LossModule, transitions: TensorDictBase) -> Tensor | None:
    """Returns the value of actions, from the critics of a loss.

    TD3 and SAC train several critics. The value is the least of their values, as in the targets. If targets
    use some critics drawn at random, the value is the mean of all critics, and in TQC the mean of all
    quantiles, since the actors follow these means. In DQN it is the value of the best action.

    Args:
        loss: loss of TorchRL, for example from :func:`~torchrl_her.objectives.make_td3_loss`.
        transitions: [...], with all entries that the critics read: for all losses but DQN also the action. If
            the loss is trained on normalized transitions, pass such ones.

    Returns:
        Values [..., 1]; None if it is not known how to call the critics of this loss.

    Example:
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from torchrl_her import make_actor, make_critic
        >>> from torchrl_her.objectives import make_td3_loss
        >>> actor, critic = make_actor((9, 2), 3), make_critic((9, 2), 3)
        >>> loss = make_td3_loss(actor, critic, action_spec=Bounded(-1.0, 1.0, (3,)))
        >>> start = TensorDict({"observation": torch.zeros(4, 9), "desired_goal": torch.zeros(4, 2)}, [4])
        >>> critic_value(loss, actor(start)).shape
        torch.Size([4, 1])
    """
    every = critic_values(loss, transitions)
    if every is None:
        return None
    mean = isinstance(loss, TQCLoss) or getattr(loss, "target_critics", 0) > 0
    return (every.mean(-1) if mean else every.amin(-1)).unsqueeze(-1)


@torch.no_grad()
def critic_values(loss: LossModule, transitions: TensorDictBase) -> Tensor | None:
    """Returns the values of actions from each critic of a loss; see :func:`critic_value`.

    Args:
        loss: loss of TorchRL.
        transitions: [...], with all entries that the critics read.

    Returns:
        Values [..., E] by E critics, in TQC the mean of each critic's quantiles; None if it is not known
        how to call the critics of this loss.
    """
    keys: Any = loss.tensor_keys
    has_actions = hasattr(keys, "state_action_value")
    if getattr(loss, "qvalue_network_params", None) is not None and has_actions:
        network, params, key = loss.qvalue_network, loss.qvalue_network_params, keys.state_action_value
    elif isinstance(loss, DDPGLoss):
        network, params, key = loss.value_network, loss.value_network_params, keys.state_action_value
    elif isinstance(loss, DQNLoss):
        network, params, key = loss.value_network, loss.value_network_params, keys.value
    else:
        return None
    training, values = network.training, []
    network.eval()  # batch normalization must neither use nor count this batch's statistics
    try:
        for weights in params.data.unbind(0) if params.ndim else [params.data]:
            with weights.to_module(network, preserve_module_state=False):
                values.append(network(transitions.select(*network.in_keys)).get(key))
    finally:
        network.train(training)
    return torch.cat([value.mean(-1, keepdim=True) for value in values], -1)


def action_key(loss: LossModule) -> Any:
    """Returns the key of the actions of a loss; DDPG's loss does not name it, but its actor does."""
    return loss.actor_network.out_keys[0] if isinstance(loss, DDPGLoss) else loss.tensor_keys.action


def least_of_some(values: Tensor, count: int, noise: RunNoise) -> Tensor:
    """Returns the least value of all critics, or of some that are drawn at random for each run.

    Args:
        values: [N, ...], values by N critics; those of a critic are one equal block for each run.
        count: number of critics that are drawn; 0 for all of them.
        noise: draws the critics, if ``count`` is not 0.
    """
    if count == 0:
        return values.amin(0)
    drawn = noise.subsets(count, len(values)).to(values.device)  # [R, count]
    blocks = values.reshape(len(values), len(drawn), -1)
    run = torch.arange(len(drawn), device=values.device)
    return blocks[drawn.T, run].amin(0).view(values.shape[1:])


def checked_subset(target_critics: int, critics: int) -> int:
    """Returns the number of critics that are drawn for targets, checked; 0 if all are used."""
    if not 0 <= target_critics <= critics:
        raise ValueError(
            f"target_critics must be from 0 (all) to the number of critics, {critics}, got {target_critics}"
        )
    return 0 if target_critics == critics else target_critics


def as_critics(
    critic: TensorDictModule | Sequence[TensorDictModule],
) -> tuple[TensorDictModule | list[TensorDictModule], int]:
    """Returns critics as TorchRL's losses take them, one or a list, and the number that the loss trains.

    From one critic, TorchRL makes two. From a list of one critic it would make buffers, which are not
    trained. The critic of such a list is therefore passed by itself; TorchRL then draws new weights, and
    :func:`connect_critics` puts the old ones back.

    Raises:
        ValueError: the list is empty, or a critic has batch normalization, whose statistics a stack of
            critics cannot move.
    """
    every = [critic] if isinstance(critic, TensorDictModule) else list(critic)
    check_whole(critics=len(every))
    for module in every:
        if any(isinstance(layer, StackedBatchNorm) for layer in module.modules()):
            raise ValueError("norm must be none or layer in critics of this loss, got 'batch' (DDPG only)")
    number = 2 if isinstance(critic, TensorDictModule) else len(every)
    return every if len(every) > 1 else every[0], number


def connect_critics(loss: LossModule, critic: TensorDictModule | Sequence[TensorDictModule]) -> None:
    """Sets a loss's keys of values and actions, and copies the weights of a critic in a list of one.

    The action is the entry that the actor writes and the critic reads.

    Args:
        loss: loss that was made with the result of :func:`as_critics`.
        critic: critic or list of critics that the loss was made with.
    """
    loss.set_keys(state_action_value=loss.qvalue_network.out_keys[0])
    actions = [key for key in loss.actor_network.out_keys if key in loss.qvalue_network.in_keys]
    if len(actions) == 1:
        loss.set_keys(action=actions[0])
    if isinstance(critic, TensorDictModule) or len(critic) > 1:
        return
    weights = TensorDict.from_module(critic[0]).data.unsqueeze(0)
    for name, params in loss.named_children():  # reading attributes makes TorchRL warn about targets
        if name in ("qvalue_network_params", "target_qvalue_network_params"):
            params.data.update_(weights)
