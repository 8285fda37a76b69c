"""DQN from TorchRL's loss, for discrete actions."""

from __future__ import annotations

from typing import Literal

from torchrl.modules import QValueActor
from torchrl.objectives import DQNLoss

from torchrl_her.objectives.targets import clamped_td0


def make_dqn_loss(
    actor: QValueActor,
    *,
    gamma: float = 0.98,
    reward_range: tuple[float, float] | None = (-1.0, 0.0),
    double: bool = True,
    reduction: Literal["mean", "none"] = "mean",
) -> DQNLoss:
    """Makes TorchRL's (double) DQN loss with a target network and clamped targets.

    Args:
        actor: from :func:`~torchrl_her.modules.make_q_actor`.
        gamma: discount, in [0, 1).
        reward_range: least and greatest reward; targets are clamped to the returns that these allow. None to
            leave them as they are.
        double: whether the online network chooses the next action (van Hasselt et al., 2016).
        reduction: ``"none"`` gives one loss for each transition [R, B], as stacked networks need it.

    Raises:
        ValueError: ``gamma`` is outside of [0, 1).

    Example:
        >>> from torchrl_her.modules import make_q_actor
        >>> loss = make_dqn_loss(make_q_actor((3, 3), 4)[0])
        >>> round(loss.value_estimator.low), round(loss.value_estimator.high)
        (-50, 0)
    """
    loss = DQNLoss(actor, delay_value=True, double_dqn=double, reduction=reduction)
    estimator = clamped_td0(gamma, reward_range, loss.value_network)
    estimator.set_keys(value="chosen_action_value")
    loss.make_value_estimator(estimator)
    return loss
