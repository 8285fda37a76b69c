"""DDPG from TorchRL's loss, with clamped targets and an action L2 penalty."""

from __future__ import annotations

from typing import Any, Literal

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.objectives import DDPGLoss

from torchrl_her.objectives.targets import clamped_td0


class PenalizedDDPGLoss(DDPGLoss):
    """TorchRL's DDPG loss with an action L2 penalty.

    The penalty keeps actions away from the flat ends of tanh: an actor that saturates early gets no
    gradient any more. As in OpenAI's HER, the mean square of the actions, times ``action_penalty``, is
    added to the actor's loss.

    Args:
        *args: of :class:`torchrl.objectives.DDPGLoss`.
        **kwargs: of the same.
        action_penalty: the weight of the penalty, at least 0.
    """

    def __init__(self, *args: Any, action_penalty: float, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.action_penalty = action_penalty

    def loss_actor(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        actions: list[Tensor] = []
        hook = self.actor_network.register_forward_hook(
            lambda _module, _inputs, output: actions.append(output.get(self.actor_network.out_keys[0]))
        )
        try:
            loss, metadata = super().loss_actor(tensordict)
        finally:
            hook.remove()
        penalty = self.action_penalty * actions[0].square().mean(-1)
        return loss + (penalty if loss.ndim else penalty.mean()), metadata


def make_ddpg_loss(
    actor: TensorDictModule,
    critic: TensorDictModule,
    *,
    gamma: float = 0.98,
    reward_range: tuple[float, float] = (-1.0, 0.0),
    action_penalty: float = 0.0,
    reduction: Literal["mean", "none"] = "mean",
) -> DDPGLoss:
    """TorchRL's DDPG loss with clamped targets, and target networks for actor and critic.

    Args:
        actor: from :func:`~torchrl_her.make_actor`.
        critic: from :func:`~torchrl_her.make_critic`.
        gamma: discount, in [0, 1).
        reward_range: least and greatest reward; targets are clamped to the returns that these allow.
        action_penalty: weight of the action L2 penalty, see
            :class:`~torchrl_her.objectives.PenalizedDDPGLoss`.
        reduction: ``"none"`` gives one loss for each transition [R, B], as stacked networks need it.

    Raises:
        ValueError: ``gamma`` is outside of [0, 1).

    Example:
        >>> from torchrl_her import make_actor, make_critic
        >>> loss = make_ddpg_loss(make_actor((9, 2), 3), make_critic((9, 2), 3))
        >>> round(loss.value_estimator.low), round(loss.value_estimator.high)
        (-50, 0)
    """
    loss = PenalizedDDPGLoss(
        actor, critic, delay_actor=True, delay_value=True, action_penalty=action_penalty, reduction=reduction
    )
    estimator = clamped_td0(gamma, reward_range, loss.actor_critic)
    loss.set_keys(state_action_value=critic.out_keys[0])
    estimator.set_keys(value=critic.out_keys[0])
    loss.make_value_estimator(estimator)
    return loss
