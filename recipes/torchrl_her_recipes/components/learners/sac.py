"""SAC."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict.nn import TensorDictModule
from torchrl.objectives import LossModule

from torchrl_her.modules.stochastic_actor import make_stochastic_actor
from torchrl_her.objectives.sac import make_sac_loss
from torchrl_her_recipes.components.learners.ddpg import DDPGBuilder


class SACBuilder(DDPGBuilder):
    """See :func:`~torchrl_her.make_sac_loss`; the critics are those of DDPG."""

    def actor(self, runs: int) -> TensorDictModule:
        return make_stochastic_actor(
            self.widths, self.action_spec, runs=runs, in_keys=self.in_keys, **self.options.actor_shape
        )

    def loss(
        self,
        actor: TensorDictModule,
        critics: Sequence[TensorDictModule],
        rewards: tuple[float, float],
        generators: Sequence[torch.Generator],
    ) -> LossModule:
        return make_sac_loss(
            actor,
            critics,
            action_spec=self.action_spec,
            critics=self.options.critics,
            gamma=self.options.gamma,
            temperature=self.options.temperature,
            action_penalty=self.options.action_penalty,
            runs=self.recipe.run.num_runs,
            generators=generators,
            reduction="none",
        )

    def epsilon(self) -> dict[str, float]:
        """None: the policy explores by itself."""
        return {"start": 0.0, "decay": 1.0, "end": 0.0}
