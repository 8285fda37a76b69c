"""TD3."""

from __future__ import annotations

from tensordict.nn import TensorDictModule
from torchrl.objectives import LossModule

from torchrl_her.objectives.td3 import make_td3_loss
from torchrl_her_recipes.components.learners.ddpg import DDPGBuilder


class TD3Builder(DDPGBuilder):
    """See :func:`~torchrl_her.make_td3_loss`; the networks are those of DDPG."""

    def loss(
        self, actor: TensorDictModule, critic: TensorDictModule, rewards: tuple[float, float]
    ) -> LossModule:
        return make_td3_loss(
            actor, critic, action_spec=self.action_spec, gamma=self.options.gamma, reward_range=rewards
        )
