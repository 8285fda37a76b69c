"""SAC from TorchRL's loss, with an action L2 penalty."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import Bounded
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import SACLoss

from torchrl_her.modules.noise import RunNoise
from torchrl_her.objectives.cloning import Cloning, with_cloning
from torchrl_her.objectives.critics import as_critics, checked_subset, keep_weights, least_of_some
from torchrl_her.objectives.targets import clamped_td0


class PenalizedSACLoss(SACLoss):
    """TorchRL's SAC loss (its second version) with an action L2 penalty, for one run or several.

    Each of R runs has its own temperature and its own random numbers.

    Actor and targets have the least value of all critics. Or targets have the least value of some that are
    drawn at random in each gradient step, and the actor follows the mean of all critics: this is REDQ (Chen
    et al., 2021). TorchRL's ``REDQLoss`` cannot be used for it: it draws one subset for all runs, from
    torch's own generator, has one temperature for all of them, and with ``reduction="none"`` it gives a loss
    for each critic where stacked runs need one for each transition.

    Args:
        *args: arguments of :class:`torchrl.objectives.SACLoss`.
        **kwargs: keyword arguments of the same class.
        action_penalty: the weight of the penalty on drawn actions, see
            :class:`~torchrl_her.objectives.PenalizedDDPGLoss`.
        cloning: options of behavior cloning, see :class:`~torchrl_her.objectives.Cloning`.
        target_critics: number of critics that are drawn for targets; 0 for all.
        runs: R.
        noise: source of its random numbers.

    Raises:
        ValueError: ``target_critics`` is not from 0 to the number of critics.
    """

    def __init__(
        self,
        *args: Any,
        action_penalty: float = 0.0,
        cloning: Cloning | None = None,
        target_critics: int = 0,
        runs: int = 1,
        noise: RunNoise | None = None,
        **kwargs: Any,
    ) -> None:
        super().__init__(*args, **kwargs)
        self.action_penalty, self.cloning, self.runs = action_penalty, cloning, runs
        self.target_critics = checked_subset(target_critics, self.num_qvalue_nets)
        self.noise = noise or RunNoise()
        start: Tensor = self.log_alpha.detach()  # type: ignore[has-type]
        dtype = next(self.actor_network_params.values(True, True)).dtype  # as fused steps need it
        self.log_alpha = nn.Parameter(start.to(dtype).repeat(runs) if runs > 1 else start.to(dtype))

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
        penalty = self.action_penalty * action.square().mean(-1)
        loss = loss + (penalty if loss.ndim else penalty.mean())
        return with_cloning(self, loss, tensordict), {"log_prob": log_prob.detach()}

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
        after = tensordict.get("next").copy()
        action, log_prob = self._draw(after)
        after.set(self.tensor_keys.action, action)
        valued = self._vmap_qnetworkN0(after, self.target_qvalue_network_params)
        values = valued.get(self.tensor_keys.state_action_value)
        value = least_of_some(values, self.target_critics, self.noise)
        value = value - (self._by_run(self._alpha, log_prob) * log_prob).unsqueeze(-1)
        tensordict.set(("next", self.value_estimator.tensor_keys.value), value)
        return self.value_estimator.value_estimate(tensordict).squeeze(-1)

    def _alpha_loss(self, log_prob: Tensor) -> Tensor:
        return -self._by_run(self.log_alpha, log_prob) * (log_prob + self.target_entropy)


def make_sac_loss(
    actor: ProbabilisticActor,
    critic: TensorDictModule | Sequence[TensorDictModule],
    *,
    action_spec: Bounded,
    critics: int = 2,
    target_critics: int = 0,
    gamma: float = 0.98,
    reward_range: tuple[float, float] | None = None,
    temperature: float = 0.1,
    action_penalty: float = 0.0,
    runs: int = 1,
    generators: Sequence[torch.Generator] | None = None,
    reduction: Literal["mean", "none"] = "mean",
    cloning: Cloning | None = None,
) -> SACLoss:
    """Makes TorchRL's SAC loss with several critics and a learned temperature.

    Targets contain the policy's entropy besides the rewards, so they may rightly be outside of the range of
    possible returns, and are not clamped unless ``reward_range`` is given. Clamping them makes sense where
    rewards outweigh entropy, as they do when the temperature has become small: an overestimated value cannot
    exceed what is possible then.

    Haarnoja et al., Soft actor-critic algorithms and applications, 2018.

    Args:
        actor: from :func:`~torchrl_her.modules.make_stochastic_actor`.
        critic: from :func:`~torchrl_her.make_critic`, the others are made like it; or all critics in a list.
        action_spec: least and greatest actions, of one environment.
        critics: number of critics; targets and policy use the least of their values.
        target_critics: number of critics drawn at random in each gradient step: targets use the least of
            their values alone, while the policy has the mean of all. 0: both have the least of all. Chen et
            al., Randomized ensembled double Q-learning, 2021.
        gamma: discount, in [0, 1).
        reward_range: least and greatest reward; targets are clamped to the returns that these allow. None to
            leave them as they are.
        temperature: first value of the temperature. At TorchRL's 1, entropy outweighs rewards of -1 and 0 for
            so long that some runs never find what is rewarded.
        action_penalty: weight of the action L2 penalty, see
            :class:`~torchrl_her.objectives.PenalizedDDPGLoss`.
        runs: R, how many runs the networks are stacked for; each has a temperature of its own.
        generators: generators of the random numbers of each run; None for torch's own.
        reduction: ``"none"`` gives one loss for each transition [R, B], as stacked networks need it.
        cloning: adds behavior cloning on rows that are marked as demonstrations; None for none.

    Raises:
        ValueError: ``gamma`` is outside of [0, 1), ``temperature`` is not positive, ``critics`` is below 1 or
            not their number, or ``target_critics`` is not from 0 to ``critics``.

    Example:
        >>> from torchrl_her import make_critic
        >>> from torchrl_her.modules import make_stochastic_actor
        >>> spec = Bounded(-1.0, 1.0, (3,))
        >>> actor, critic = make_stochastic_actor((9, 2), spec), make_critic((9, 2), 3)
        >>> loss = make_sac_loss(actor, critic, action_spec=spec)
        >>> loss.num_qvalue_nets
        2
    """
    networks = as_critics(critic, critics)
    loss = PenalizedSACLoss(
        actor,
        networks,
        action_spec=action_spec,
        num_qvalue_nets=critics,
        loss_function="l2",
        alpha_init=positive_temperature(temperature),
        action_penalty=action_penalty,
        target_critics=target_critics,
        runs=runs,
        noise=RunNoise(generators),
        reduction=reduction,
        scalar_output_mode="exclude" if reduction == "none" else None,
        cloning=cloning,
    )
    keep_weights(loss, critic)
    loss.set_keys(state_action_value=(networks[0] if isinstance(networks, list) else networks).out_keys[0])
    set_soft_targets(loss, gamma, reward_range)
    return loss


def positive_temperature(temperature: float) -> float:
    """Returns a temperature, which must be positive.

    Raises:
        ValueError: it is not positive.
    """
    if not temperature > 0:
        raise ValueError(f"temperature must be positive, got {temperature}")
    return temperature


def set_soft_targets(loss: SACLoss, gamma: float, reward_range: tuple[float, float] | None) -> None:
    """Gives a loss targets of one or several steps, clamped to possible returns if these are given.

    Raises:
        ValueError: ``gamma`` is outside of [0, 1).
    """
    clamped = clamped_td0(gamma, reward_range)
    if reward_range is None:
        loss.make_value_estimator(gamma=gamma)
    else:
        clamped.set_keys(value=loss.tensor_keys.value)
        loss.make_value_estimator(clamped)
