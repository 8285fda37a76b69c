"""TQC."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict.nn import TensorDictModule
from torchrl.objectives import LossModule

from torchrl_her.modules.networks import make_critic
from torchrl_her.objectives.tqc import make_tqc_loss
from torchrl_her_recipes.components.learners.sac import SACBuilder


class TQCBuilder(SACBuilder):
    """See :func:`~torchrl_her.make_tqc_loss`; the actor is that of SAC."""

    def critic(self, runs: int) -> TensorDictModule:
        return make_critic(
            self.widths,
            self.action_spec.shape[-1],
            runs=runs,
            outputs=self.options.quantiles,
            in_keys=self.in_keys,
            **self.options.critic_shape,
        )

    def loss(
        self,
        actor: TensorDictModule,
        critics: Sequence[TensorDictModule],
        rewards: tuple[float, float],
        generators: Sequence[torch.Generator],
    ) -> LossModule:
        return make_tqc_loss(
            actor,
            critics,
            action_spec=self.action_spec,
            critics=self.options.critics,
            dropped_quantiles=self.options.dropped_quantiles,
            gamma=self.options.gamma,
            reward_range=self.bounds(rewards),
            temperature=self.options.temperature,
            action_penalty=self.options.action_penalty,
            runs=self.recipe.run.num_runs,
            generators=generators,
            reduction="none",
        )
