"""TQC from TorchRL's loss, with further terms in its actor's loss."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import TQCLoss

from torchrl_her.modules.noise import RunNoise
from torchrl_her.objectives.actor_terms import ActorTerms
from torchrl_her.objectives.critics import as_critics, connect_critics
from torchrl_her.objectives.sac import PenalizedSACLoss
from torchrl_her.objectives.targets import Targets


class PenalizedTQCLoss(PenalizedSACLoss, TQCLoss):
    """TorchRL's TQC loss with further terms in its actor's loss, for one run or several.

    Critics give quantiles of the return instead of its mean. Targets are the quantiles of all critics without
    the greatest ones, and each critic learns all targets. The actor follows the mean of all quantiles.

    Priorities are absolute TD errors: the mean distance between a critic's quantiles and the targets, for the
    critic with the greatest distance.

    Args:
        *args: arguments of :class:`torchrl.objectives.TQCLoss`.
        **kwargs: keyword arguments of the same class, and of
            :class:`~torchrl_her.objectives.PenalizedSACLoss`, but for ``target_critics``.

    Raises:
        TypeError: ``target_critics`` is given.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        if "target_critics" in kwargs:
            raise TypeError(
                "TQC's targets use the quantiles of all critics, not of some that are drawn at random: "
                f"leave out target_critics={kwargs['target_critics']!r}"
            )
        super().__init__(*args, **kwargs)

    def _value_for_actor(self, values: Tensor) -> Tensor:
        return values.mean((0, -1))

    @torch.no_grad()
    def compute_target(self, tensordict: TensorDictBase) -> Tensor:
        """Computes the targets [..., K]: the least K quantiles of all critics together."""
        values, entropy = self._target_values(tensordict.get("next").copy())
        every = values.movedim(0, -2).flatten(-2)
        kept = every.shape[-1] - self.top_quantiles_to_drop_per_net * self.num_qvalue_nets
        value = every.sort(-1).values[..., :kept] + entropy
        keys, steps_key = self.tensor_keys, self.value_estimator.tensor_keys.steps_to_next_obs
        entries = [("next", key) for key in (keys.reward, keys.done, keys.terminated)]
        rows = tensordict.select(*entries, steps_key, strict=False)
        rows = rows.apply(lambda entry: entry.expand_as(value))  # TorchRL's targets need one shape
        return self.value_estimator.value_estimate(rows, next_value=value)


def make_tqc_loss(
    actor: ProbabilisticActor,
    critic: TensorDictModule | Sequence[TensorDictModule],
    *,
    dropped_quantiles: int = 2,
    targets: Targets = Targets(reward_range=None),
    temperature: float = 0.1,
    terms: ActorTerms = ActorTerms(),
    reduction: Literal["mean", "none"] = "mean",
) -> TQCLoss:
    """Makes TorchRL's TQC loss: critics give quantiles, and targets leave out the greatest ones.

    Kuznetsov et al., Controlling overestimation bias with truncated mixture of continuous distributional
    quantile critics, 2020.

    Args:
        actor: actor from :func:`~torchrl_her.modules.make_stochastic_actor`, with its generators.
        critic: a critic with M quantiles from ``make_critic(..., outputs=M)``, to which TorchRL adds a second
            of the same shape, or a list of all N critics.
        dropped_quantiles: D; targets leave out the D * N greatest of all N * M quantiles.
        targets, temperature, terms, reduction: as in :func:`~torchrl_her.objectives.make_sac_loss`.

    Raises:
        ValueError: ``temperature`` is not positive, the list of critics is empty, a critic's module lacks the
            attribute ``outputs``, which critics of ``make_critic`` have, or ``dropped_quantiles`` is
            negative or leaves no quantile.

    Example:
        >>> from torchrl.data import Bounded
        >>> from torchrl_her import make_critic
        >>> from torchrl_her.modules import make_stochastic_actor
        >>> actor = make_stochastic_actor((9, 2), Bounded(-1.0, 1.0, (3,)))
        >>> make_tqc_loss(actor, make_critic((9, 2), 3, outputs=25)).top_quantiles_to_drop_per_net
        2
    """
    networks, number = as_critics(critic)
    first = networks[0] if isinstance(networks, list) else networks
    quantiles = getattr(first.module, "outputs", None)
    if not isinstance(quantiles, int):
        raise ValueError(
            "critic must come from make_critic(..., outputs=M) with M quantiles, or its module must have "
            f"their number as the attribute `outputs`, got {type(first.module).__name__} without it"
        )
    if not 0 <= dropped_quantiles < quantiles:
        hint = "" if quantiles > 1 else "; make_critic(..., outputs=M) gives critics with M quantiles"
        raise ValueError(
            f"dropped_quantiles must be from 0 to {quantiles - 1}, since critics have {quantiles} "
            f"quantile{'s' * (quantiles != 1)}, got {dropped_quantiles}{hint}"
        )
    loss = PenalizedTQCLoss(
        actor,
        networks,
        num_qvalue_nets=number,
        top_quantiles_to_drop_per_net=dropped_quantiles,
        alpha_init=temperature,
        terms=terms,
        noise=RunNoise(getattr(actor, "generators", None)),
        reduction=reduction,
        scalar_output_mode="exclude" if reduction == "none" else None,
    )
    connect_critics(loss, critic)
    loss.make_value_estimator(targets.estimator(value_key=loss.tensor_keys.value))
    return loss
