"""SAC from TorchRL's loss, with further terms in its actor's loss."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import SACLoss

from torchrl_her.modules.networks import stacked_runs
from torchrl_her.modules.noise import RunNoise
from torchrl_her.objectives.actor_terms import ActorTerms
from torchrl_her.objectives.critics import as_critics, checked_subset, connect_critics, least_of_some
from torchrl_her.objectives.targets import Targets


class PenalizedSACLoss(SACLoss):
    """TorchRL's SAC loss (its second version) with further terms in its actor's loss, for several runs.

    Each of R runs has its own temperature and its own random numbers.

    Actor and targets use the least value of all critics. With ``target_critics`` above 0, targets use the
    least value of some critics, drawn at random in each gradient step, and the actor follows the mean of all
    critics: this is REDQ (Chen et al., 2021). TorchRL's ``REDQLoss`` does not serve for several runs. It
    draws one subset of critics for all runs, from torch's own generator, and has one temperature. With
    ``reduction="none"`` it returns a loss for each critic, not for each transition.

    Args:
        *args: arguments of :class:`torchrl.objectives.SACLoss`.
        **kwargs: keyword arguments of the same class.
        terms: terms that are added to the actor's loss; penalties act on drawn actions.
        target_critics: number of critics that are drawn for targets; 0 for all.
        noise: source of the loss's random numbers.

    Raises:
        ValueError: ``target_critics`` is not from 0 to the number of critics, ``alpha_init`` is not positive,
            or ``terms`` have a saturation penalty.
    """

    def __init__(
        self,
        *args: Any,
        terms: ActorTerms = ActorTerms(),
        target_critics: int = 0,
        noise: RunNoise | None = None,
        **kwargs: Any,
    ) -> None:
        if not kwargs.get("alpha_init", 1.0) > 0:
            raise ValueError(f"temperature must be positive, got {kwargs['alpha_init']}")
        super().__init__(*args, **kwargs)
        if terms.saturation_penalty:
            raise ValueError("saturation_penalty is for deterministic actors; choose action_penalty")
        self.terms, self.runs = terms, stacked_runs(self.actor_network)
        self.target_critics = checked_subset(target_critics, self.num_qvalue_nets)
        self.noise = noise or RunNoise()
        start: Tensor = self.log_alpha.detach()  # type: ignore[has-type]
        dtype = next(self.actor_network_params.values(True, True)).dtype  # fused steps need one dtype
        self.log_alpha = nn.Parameter(start.to(dtype).repeat(self.runs) if self.runs > 1 else start.to(dtype))

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        weights = self._maybe_get_priority_weight(tensordict)
        action, log_prob = self._draw(tensordict)
        seen = tensordict.select(*self.qvalue_network.in_keys, strict=False)
        seen.set(self.tensor_keys.action, action)
        valued = self._vmap_qnetworkN0(seen, self._cached_detached_qvalue_params)
        value = self._value_for_actor(valued.get(self.tensor_keys.state_action_value))
        loss = self._reduce_loss(
            self._by_run(self._alpha, log_prob) * log_prob - value, tensordict=tensordict, weights=weights
        )
        return self.terms.add_to(loss, self, action, tensordict), {"log_prob": log_prob.detach()}

    def _value_for_actor(self, values: Tensor) -> Tensor:
        """Returns the value [...] that the actor maximizes, from the outputs [N, ..., 1] of N critics."""
        return (values.mean(0) if self.target_critics else values.amin(0)).squeeze(-1)

    def _draw(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Draws an action [..., a] for each row; returns it with the logarithm of its likelihood [...]."""
        with (
            set_exploration_type(ExplorationType.RANDOM),
            self.actor_network_params.to_module(self.actor_network, preserve_module_state=False),
        ):
            dist = self.actor_network.get_dist(tensordict)
        before = dist.loc + dist.scale * self.noise(dist.loc)
        squash = dist.transforms[0]
        action = squash(before)
        return action, dist.base_dist.log_prob(before) - squash.log_abs_det_jacobian(before, action).sum(-1)

    def _by_run(self, number: Tensor, like: Tensor) -> Tensor:
        """Expands a number [R] of each run to the shape of rows [R, B]; returns a single number unchanged."""
        return number.view(-1, *[1] * (like.ndim - 1)) if self.runs > 1 else number

    @torch.no_grad()
    def _compute_target_v2(self, tensordict: TensorDictBase) -> Tensor:
        tensordict = tensordict.clone(False)
        values, entropy = self._target_values(tensordict.get("next").copy())
        value = least_of_some(values, self.target_critics, self.noise) + entropy
        tensordict.set(("next", self.value_estimator.tensor_keys.value), value)
        return self.value_estimator.value_estimate(tensordict).squeeze(-1)

    def _target_values(self, after: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Draws actions; returns their values by N target critics [N, ..., M], and their entropy [..., 1]."""
        action, log_prob = self._draw(after)
        after.set(self.tensor_keys.action, action)
        valued = self._vmap_qnetworkN0(after, self.target_qvalue_network_params)
        entropy = -(self._by_run(self._alpha, log_prob) * log_prob).unsqueeze(-1)
        return valued.get(self.tensor_keys.state_action_value), entropy

    def _alpha_loss(self, log_prob: Tensor) -> Tensor:
        return -self._by_run(self.log_alpha, log_prob) * (log_prob + self.target_entropy)


def make_sac_loss(
    actor: ProbabilisticActor,
    critic: TensorDictModule | Sequence[TensorDictModule],
    *,
    target_critics: int = 0,
    targets: Targets = Targets(reward_range=None),
    temperature: float = 0.1,
    terms: ActorTerms = ActorTerms(),
    reduction: Literal["mean", "none"] = "mean",
) -> SACLoss:
    """Makes TorchRL's SAC loss with several critics and a learned temperature.

    Targets contain the policy's entropy besides the rewards, so they may rightly be outside of the range of
    possible returns, and are not clamped unless ``targets`` have a range of rewards. Clamping them makes
    sense where rewards outweigh entropy, as they do when the temperature has become small: then no
    overestimated value exceeds the possible returns.

    Haarnoja et al., Soft actor-critic algorithms and applications, 2018.

    Args:
        actor: actor from :func:`~torchrl_her.modules.make_stochastic_actor`, with its generators. Each run of
            stacked networks has its own temperature.
        critic: a critic from :func:`~torchrl_her.make_critic`, to which TorchRL adds a second of the same
            shape, or a list of all critics. Targets and policy use the least of the critics' values.
        target_critics: number of critics drawn at random in each gradient step: targets use the least of
            their values, while the policy maximizes the mean of all critics. With 0, both use the least value
            of all critics. Chen et al., Randomized ensembled double Q-learning, 2021.
        targets: discount, and the range of rewards; targets are clamped to the returns it allows.
        temperature: initial temperature. With TorchRL's default of 1, entropy outweighs rewards of -1 and 0
            for so long that some runs never achieve a goal.
        terms: further terms of the actor's loss, without a saturation penalty.
        reduction: ``"none"`` gives one loss for each transition [R, B], as stacked networks need it.

    Raises:
        ValueError: ``temperature`` is not positive, the list of critics is empty, or ``target_critics`` is
            not from 0 to their number.

    Example:
        >>> from torchrl.data import Bounded
        >>> from torchrl_her import make_critic
        >>> from torchrl_her.modules import make_stochastic_actor
        >>> actor = make_stochastic_actor((9, 2), Bounded(-1.0, 1.0, (3,)))
        >>> loss = make_sac_loss(actor, make_critic((9, 2), 3))
        >>> loss.num_qvalue_nets
        2
    """
    networks, number = as_critics(critic)
    loss = PenalizedSACLoss(
        actor,
        networks,
        num_qvalue_nets=number,
        loss_function="l2",
        alpha_init=temperature,
        terms=terms,
        target_critics=target_critics,
        noise=RunNoise(getattr(actor, "generators", None)),
        reduction=reduction,
        scalar_output_mode="exclude" if reduction == "none" else None,
    )
    connect_critics(loss, critic)
    loss.make_value_estimator(targets.estimator(value_key=loss.tensor_keys.value))
    return loss
