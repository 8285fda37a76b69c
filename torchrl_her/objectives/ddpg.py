"""DDPG from TorchRL's loss, with clamped targets and a cost of actions."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Literal

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.objectives import DDPGLoss

from torchrl_her.objectives.action_cost import action_cost
from torchrl_her.objectives.cloning import Cloning, with_cloning
from torchrl_her.objectives.targets import clamped_td0


class PenalizedDDPGLoss(DDPGLoss):
    """TorchRL's DDPG loss with a cost of actions, see :func:`~torchrl_her.objectives.action_cost`.

    Args:
        *args: arguments of :class:`torchrl.objectives.DDPGLoss`.
        **kwargs: keyword arguments of the same class.
        action_penalty: weight of the action L2 penalty, at least 0.
        saturation_penalty: weight of the saturation penalty, at least 0.
        cloning: adds behavior cloning on rows that are marked as demonstrations; None for none.
    """

    def __init__(
        self,
        *args: Any,
        action_penalty: float = 0.0,
        saturation_penalty: float = 0.0,
        cloning: Cloning | None = None,
        **kwargs: Any,
    ) -> None:
        super().__init__(*args, **kwargs)
        self.action_penalty, self.saturation_penalty = action_penalty, saturation_penalty
        self.cloning = cloning

    def loss_actor(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        with actions_of(self.actor_network) as actions:
            loss, metadata = super().loss_actor(tensordict)
        cost = action_cost(actions[0], l2=self.action_penalty, saturation=self.saturation_penalty)
        loss = loss + (cost if loss.ndim else cost.mean())
        return with_cloning(self, loss, tensordict), metadata


@contextmanager
def actions_of(actor: TensorDictModule) -> Iterator[list[Tensor]]:
    """Collects the actions [..., a] of each call of an actor in the ``with`` block.

    Args:
        actor: its first output is the action.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> actor = TensorDictModule(nn.Identity(), in_keys=["wish"], out_keys=["action"])
        >>> with actions_of(actor) as actions:
        ...     _ = actor(TensorDict({"wish": torch.tensor([[1.0], [2.0]])}, [2]))
        >>> actions[0].tolist()
        [[1.0], [2.0]]
    """
    actions: list[Tensor] = []

    def note(_module: nn.Module, _inputs: Any, output: TensorDictBase) -> None:
        actions.append(output.get(actor.out_keys[0]))

    hook = actor.register_forward_hook(note)
    try:
        yield actions
    finally:
        hook.remove()


def make_ddpg_loss(
    actor: TensorDictModule,
    critic: TensorDictModule,
    *,
    gamma: float = 0.98,
    reward_range: tuple[float, float] | None = (-1.0, 0.0),
    action_penalty: float = 0.0,
    saturation_penalty: float = 0.0,
    reduction: Literal["mean", "none"] = "mean",
    cloning: Cloning | None = None,
) -> DDPGLoss:
    """Makes TorchRL's DDPG loss with clamped targets, and target networks for actor and critic.

    Args:
        actor: from :func:`~torchrl_her.make_actor`.
        critic: from :func:`~torchrl_her.make_critic`.
        gamma: discount, in [0, 1).
        reward_range: least and greatest reward; targets are clamped to the returns that these allow. None to
            leave them as they are.
        action_penalty, saturation_penalty: weights of the costs of actions, see
            :func:`~torchrl_her.objectives.action_cost`.
        reduction: ``"none"`` gives one loss for each transition [R, B], as stacked networks need it.
        cloning: adds behavior cloning on rows that are marked as demonstrations; None for none.

    Raises:
        ValueError: ``gamma`` is outside of [0, 1).

    Example:
        >>> from torchrl_her import make_actor, make_critic
        >>> loss = make_ddpg_loss(make_actor((9, 2), 3), make_critic((9, 2), 3))
        >>> round(loss.value_estimator.low), round(loss.value_estimator.high)
        (-50, 0)
    """
    loss = PenalizedDDPGLoss(
        actor,
        critic,
        delay_actor=True,
        delay_value=True,
        action_penalty=action_penalty,
        saturation_penalty=saturation_penalty,
        reduction=reduction,
        cloning=cloning,
    )
    estimator = clamped_td0(gamma, reward_range, loss.actor_critic)
    loss.set_keys(state_action_value=critic.out_keys[0])
    estimator.set_keys(value=critic.out_keys[0])
    loss.make_value_estimator(estimator)
    return loss
