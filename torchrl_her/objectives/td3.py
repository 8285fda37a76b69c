"""TD3 from TorchRL's loss, with clamped targets and an action L2 penalty."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import Bounded
from torchrl.objectives import TD3Loss

from torchrl_her.objectives.critics import as_critics
from torchrl_her.objectives.ddpg import action_penalty_of
from torchrl_her.objectives.noise import RunNoise
from torchrl_her.objectives.targets import clamped_td0


class PenalizedTD3Loss(TD3Loss):
    """TorchRL's TD3 loss with an action L2 penalty, and with random numbers of each run's own.

    Args:
        *args: of :class:`torchrl.objectives.TD3Loss`.
        **kwargs: of the same, without ``policy_noise`` and ``noise_clip``.
        action_penalty: the weight of the penalty, see :class:`~torchrl_her.objectives.PenalizedDDPGLoss`.
        target_noise: standard deviation of the noise on the target's actions.
        target_noise_clip: the greatest noise.
        noise: where its random numbers come from.
    """

    def __init__(
        self,
        *args: Any,
        action_penalty: float = 0.0,
        target_noise: float = 0.2,
        target_noise_clip: float = 0.5,
        noise: RunNoise | None = None,
        **kwargs: Any,
    ) -> None:
        super().__init__(*args, policy_noise=0.0, noise_clip=0.0, **kwargs)
        self.action_penalty = action_penalty
        self.target_noise, self.target_noise_clip = target_noise, target_noise_clip
        self.noise = noise or RunNoise()

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        with action_penalty_of(self.actor_network, self.action_penalty) as penalties:
            loss, metadata = super().actor_loss(tensordict)
        return loss + (penalties[0] if loss.ndim else penalties[0].mean()), metadata

    def value_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        key = self.actor_network.out_keys[0]

        def smooth(_module: nn.Module, _inputs: Any, output: TensorDictBase) -> None:
            action = output.get(key)
            noise = (self.noise(action) * self.target_noise).clamp(
                -self.target_noise_clip, self.target_noise_clip
            )
            output.set(key, action + noise)  # TorchRL's loss clamps it to the range of actions

        hook = self.actor_network.register_forward_hook(smooth)
        try:
            return super().value_loss(tensordict)
        finally:
            hook.remove()


def make_td3_loss(
    actor: TensorDictModule,
    critic: TensorDictModule | Sequence[TensorDictModule],
    *,
    action_spec: Bounded,
    critics: int = 2,
    gamma: float = 0.98,
    reward_range: tuple[float, float] = (-1.0, 0.0),
    action_penalty: float = 0.0,
    generators: Sequence[torch.Generator] | None = None,
    reduction: Literal["mean", "none"] = "mean",
) -> TD3Loss:
    """TorchRL's TD3 loss: several critics, and targets smoothed by noise and clamped.

    The actor learns in every step, as in DDPG, and not in every second one.

    Fujimoto et al., Addressing function approximation error in actor-critic methods, 2018.

    Args:
        actor: from :func:`~torchrl_her.make_actor`.
        critic: from :func:`~torchrl_her.make_critic`, the others are made like it; or all critics in a list.
        action_spec: least and greatest actions, of one environment.
        critics: how many there are; targets have the least of their values.
        gamma: discount, in [0, 1).
        reward_range: least and greatest reward; targets are clamped to the returns that these allow.
        action_penalty: weight of the action L2 penalty, see
            :class:`~torchrl_her.objectives.PenalizedDDPGLoss`.
        generators: of the random numbers of each run; None for torch's own.
        reduction: ``"none"`` gives one loss for each transition [R, B], as stacked networks need it.

    Raises:
        ValueError: ``gamma`` is outside of [0, 1), or ``critics`` is below 1 or not their number.

    Example:
        >>> from torchrl_her import make_actor, make_critic
        >>> loss = make_td3_loss(
        ...     make_actor((9, 2), 3), make_critic((9, 2), 3), action_spec=Bounded(-1.0, 1.0, (3,))
        ... )
        >>> loss.num_qvalue_nets
        2
    """
    own = as_critics(critic, critics)
    loss = PenalizedTD3Loss(
        actor,
        own,
        action_spec=action_spec,
        num_qvalue_nets=critics,
        loss_function="l2",
        action_penalty=action_penalty,
        noise=RunNoise(generators),
        reduction=reduction,
    )
    key = (own[0] if isinstance(own, list) else own).out_keys[0]
    estimator = clamped_td0(gamma, reward_range)
    loss.set_keys(state_action_value=key)
    estimator.set_keys(value=key)
    loss.make_value_estimator(estimator)
    return loss
