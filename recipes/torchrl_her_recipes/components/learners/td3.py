"""Builder of TD3: networks, loss and exploration."""

from __future__ import annotations

from collections.abc import Sequence

from tensordict.nn import TensorDictModule
from torchrl.objectives import LossModule

from torchrl_her.objectives.td3 import make_td3_loss
from torchrl_her_recipes.components.devices import place_of
from torchrl_her_recipes.components.learners.ddpg import DDPGBuilder


class TD3Builder(DDPGBuilder):
    """Builds TD3, see :func:`~torchrl_her.objectives.make_td3_loss`, with the networks of DDPG."""

    def loss(self, actor: TensorDictModule, critics: Sequence[TensorDictModule]) -> LossModule:
        return make_td3_loss(
            actor,
            critics,
            action_spec=self.action_spec.to(place_of(actor)),
            target_critics=self.options.target_critics,
            generators=self.generators,
            **self.loss_options(),
        )
