"""TD3 from TorchRL's loss, with clamped targets and a cost of actions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import torch
from tensordict import TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.data import Bounded
from torchrl.objectives import TD3Loss
from torchrl.objectives.utils import distance_loss

from torchrl_her.modules.noise import RunNoise
from torchrl_her.objectives.actor_terms import ActorTerms
from torchrl_her.objectives.critics import as_critics, checked_subset, connect_critics, least_of_some
from torchrl_her.objectives.targets import Targets


class PenalizedTD3Loss(TD3Loss):
    """TorchRL's TD3 loss with further terms in its actor's loss, and separate random numbers for each run.

    Targets use the least value of all critics, or of some that are drawn at random in each gradient step, as
    in REDQ (Chen et al., 2021). With such a subset, the actor follows the mean of all critics; otherwise
    it follows the first critic.

    Args:
        *args: arguments of :class:`torchrl.objectives.TD3Loss`.
        **kwargs: keyword arguments of the same class, without ``policy_noise`` and ``noise_clip``.
        terms: terms that are added to the actor's loss.
        target_critics: number of critics that are drawn for targets; 0 for all.
        target_noise: standard deviation of the noise on the target's actions.
        target_noise_clip: bound of that noise.
        noise: source of the loss's random numbers.

    Raises:
        ValueError: ``target_critics`` is not from 0 to the number of critics, or ``target_noise`` is
            negative.
    """

    def __init__(
        self,
        *args: Any,
        terms: ActorTerms = ActorTerms(),
        target_critics: int = 0,
        target_noise: float = 0.2,
        target_noise_clip: float = 0.5,
        noise: RunNoise | None = None,
        **kwargs: Any,
    ) -> None:
        if not target_noise >= 0:
            raise ValueError(f"target_noise must be at least 0, got {target_noise}")
        super().__init__(*args, policy_noise=0.0, noise_clip=0.0, **kwargs)
        self.terms = terms
        self.target_critics = checked_subset(target_critics, self.num_qvalue_nets)
        self.target_noise, self.target_noise_clip = target_noise, target_noise_clip
        self.noise = noise or RunNoise()

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        weights = self._maybe_get_priority_weight(tensordict)
        acted = self._act(tensordict, self.actor_network_params)
        values = self._values(acted, self._cached_detach_qvalue_network_params)
        value = values.mean(0) if self.target_critics else values[0]
        loss = self._reduce_loss(-value, tensordict=tensordict, weights=weights)
        loss = self.terms.add_to(loss, self, acted.get(self.tensor_keys.action), tensordict)
        return loss, {"state_action_value_actor": values.detach()}

    def value_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        weights = self._maybe_get_priority_weight(tensordict)
        tensordict = tensordict.clone(False)
        with torch.no_grad():
            after = self._next_value(tensordict)
            tensordict.set(("next", self.tensor_keys.state_action_value), after.unsqueeze(-1))
        values = self._values(tensordict, self.qvalue_network_params)
        target = self.value_estimator.value_estimate(tensordict).squeeze(-1)
        loss = distance_loss(values, target.expand_as(values), loss_function=self.loss_function).sum(0)
        metadata = {
            "td_error": (values - target).pow(2),
            "next_state_value": after,
            "pred_value": values.detach(),
            "target_value": target.detach(),
        }
        return self._reduce_loss(loss, tensordict=tensordict, weights=weights), metadata

    def _next_value(self, tensordict: TensorDictBase) -> Tensor:
        """Returns the value [...] of the next state, where the target actor acts with noise."""
        after = self._act(tensordict.get("next"), self.target_actor_network_params)
        action = after.get(self.tensor_keys.action)
        noise = (self.noise(action) * self.target_noise).clamp(
            -self.target_noise_clip, self.target_noise_clip
        )
        after.set(self.tensor_keys.action, (action + noise).clamp(self.min_action, self.max_action))
        values = self._values(after, self.target_qvalue_network_params)
        return least_of_some(values, self.target_critics, self.noise)

    def _act(self, tensordict: TensorDictBase, params: TensorDictParams) -> TensorDictBase:
        """Returns the inputs of an actor, and its action."""
        with params.to_module(self.actor_network, preserve_module_state=False):
            return self.actor_network(tensordict.select(*self.actor_network.in_keys, strict=False))

    def _values(self, tensordict: TensorDictBase, params: TensorDictBase) -> Tensor:
        """Returns the values [N, ...] that N critics give to actions."""
        seen = tensordict.select(*self.qvalue_network.in_keys, strict=False)
        valued = self._vmap_qvalue_network00(seen.expand(self.num_qvalue_nets, *seen.batch_size), params)
        return valued.get(self.tensor_keys.state_action_value).squeeze(-1)


def make_td3_loss(
    actor: TensorDictModule,
    critic: TensorDictModule | Sequence[TensorDictModule],
    *,
    action_spec: Bounded,
    target_critics: int = 0,
    target_noise: float = 0.2,
    targets: Targets = Targets(reward_range=(-1.0, 0.0)),
    terms: ActorTerms = ActorTerms(),
    generators: Sequence[torch.Generator] | None = None,
    reduction: Literal["mean", "none"] = "mean",
) -> TD3Loss:
    """Makes TorchRL's TD3 loss: several critics, and targets smoothed by noise and clamped.

    The actor learns in every step, as in DDPG, and not in every second one.

    Fujimoto et al., Addressing function approximation error in actor-critic methods, 2018.

    Args:
        actor: actor from :func:`~torchrl_her.make_actor`.
        critic: a critic from :func:`~torchrl_her.make_critic`, to which TorchRL adds a second of the same
            shape, or a list of all critics. Targets use the least of the critics' values.
        action_spec: spec of one environment's action, with its bounds.
        target_critics: number of critics drawn at random in each gradient step, whose least value targets
            use; 0 for all. Chen et al., Randomized ensembled double Q-learning, 2021.
        target_noise: standard deviation of the noise on the target's actions, in their own unit. It blurs
            values over actions: use 0 where a little of an action decides.
        targets: discount, and the range of rewards; targets are clamped to the returns it allows.
        terms: further terms of the actor's loss.
        generators: generators of the random numbers of each run; None for torch's own.
        reduction: ``"none"`` gives one loss for each transition [R, B], as stacked networks need it.

    Raises:
        ValueError: the list of critics is empty, ``target_critics`` is not from 0 to their number, or
            ``target_noise`` is negative.

    Example:
        >>> from torchrl_her import make_actor, make_critic
        >>> loss = make_td3_loss(
        ...     make_actor((9, 2), 3), make_critic((9, 2), 3), action_spec=Bounded(-1.0, 1.0, (3,))
        ... )
        >>> loss.num_qvalue_nets
        2
    """
    networks, number = as_critics(critic)
    loss = PenalizedTD3Loss(
        actor,
        networks,
        action_spec=action_spec,
        num_qvalue_nets=number,
        loss_function="l2",
        terms=terms,
        target_critics=target_critics,
        target_noise=target_noise,
        noise=RunNoise(generators),
        reduction=reduction,
    )
    connect_critics(loss, critic)
    loss.make_value_estimator(targets.estimator(value_key=loss.tensor_keys.state_action_value))
    return loss
