"""SAC from TorchRL's loss."""

from __future__ import annotations

from tensordict.nn import TensorDictModule
from torchrl.data import Bounded
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import SACLoss


def make_sac_loss(
    actor: ProbabilisticActor, critic: TensorDictModule, *, action_spec: Bounded, gamma: float = 0.98
) -> SACLoss:
    """TorchRL's SAC loss with two critics and a learned temperature.

    Targets are not clamped, since they contain the policy's entropy besides the rewards.

    Args:
        actor: from :func:`~torchrl_her.make_stochastic_actor`.
        critic: from :func:`~torchrl_her.make_critic`; the second critic is made like it.
        action_spec: least and greatest actions, of one environment.
        gamma: discount, in [0, 1).

    Raises:
        ValueError: ``gamma`` is outside of [0, 1).

    Example:
        >>> from torchrl_her import make_critic, make_stochastic_actor
        >>> spec = Bounded(-1.0, 1.0, (3,))
        >>> actor, critic = make_stochastic_actor((9, 2), spec), make_critic((9, 2), 3)
        >>> loss = make_sac_loss(actor, critic, action_spec=spec)
        >>> loss.num_qvalue_nets
        2
    """
    if not 0.0 <= gamma < 1.0:
        raise ValueError(f"gamma must be in [0, 1), got {gamma}")
    loss = SACLoss(actor, critic, action_spec=action_spec, num_qvalue_nets=2, loss_function="l2")
    loss.make_value_estimator(gamma=gamma)
    return loss
