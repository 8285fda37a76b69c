"""DQN from TorchRL's loss, for discrete actions."""

from __future__ import annotations

from typing import Literal

from torchrl.modules import QValueActor
from torchrl.objectives import DQNLoss

from torchrl_her.objectives.targets import Targets


def make_dqn_loss(
    actor: QValueActor,
    *,
    targets: Targets = Targets(reward_range=(-1.0, 0.0)),
    reduction: Literal["mean", "none"] = "mean",
) -> DQNLoss:
    """Makes TorchRL's double DQN loss (van Hasselt et al., 2016) with a target network and clamped targets.

    Args:
        actor: actor from :func:`~torchrl_her.modules.make_q_actor`.
        targets: discount, and the range of rewards; targets are clamped to the returns it allows.
        reduction: ``"none"`` gives one loss for each transition [R, B], as stacked networks need it.

    Example:
        >>> from torchrl_her.modules import make_q_actor
        >>> loss = make_dqn_loss(make_q_actor((3, 3), 4)[0])
        >>> round(loss.value_estimator.low), round(loss.value_estimator.high)
        (-50, 0)
    """
    loss = DQNLoss(actor, delay_value=True, double_dqn=True, reduction=reduction)
    loss.make_value_estimator(targets.estimator(loss.value_network, value_key="chosen_action_value"))
    return loss
