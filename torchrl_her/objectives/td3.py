"""TD3 from TorchRL's loss, with clamped targets."""

from __future__ import annotations

from tensordict.nn import TensorDictModule
from torchrl.data import Bounded
from torchrl.objectives import TD3Loss

from torchrl_her.objectives.targets import clamped_td0


def make_td3_loss(
    actor: TensorDictModule,
    critic: TensorDictModule,
    *,
    action_spec: Bounded,
    gamma: float = 0.98,
    reward_range: tuple[float, float] = (-1.0, 0.0),
) -> TD3Loss:
    """TorchRL's TD3 loss: two critics, and targets smoothed by noise and clamped.

    The actor learns in every step, as in DDPG, and not in every second one.

    Fujimoto et al., Addressing function approximation error in actor-critic methods, 2018.

    Args:
        actor: from :func:`~torchrl_her.make_actor`.
        critic: from :func:`~torchrl_her.make_critic`; the second critic is made like it.
        action_spec: least and greatest actions, of one environment.
        gamma: discount, in [0, 1).
        reward_range: least and greatest reward; targets are clamped to the returns that these allow.

    Raises:
        ValueError: ``gamma`` is outside of [0, 1).

    Example:
        >>> from torchrl_her import make_actor, make_critic
        >>> loss = make_td3_loss(
        ...     make_actor((9, 2), 3), make_critic((9, 2), 3), action_spec=Bounded(-1.0, 1.0, (3,))
        ... )
        >>> loss.num_qvalue_nets
        2
    """
    loss = TD3Loss(actor, critic, action_spec=action_spec, num_qvalue_nets=2, loss_function="l2")
    estimator = clamped_td0(gamma, reward_range)
    estimator.set_keys(value="state_action_value")
    loss.make_value_estimator(estimator)
    return loss
