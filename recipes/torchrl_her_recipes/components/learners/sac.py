"""SAC."""

from __future__ import annotations

from tensordict.nn import TensorDictModule
from torchrl.objectives import LossModule

from torchrl_her.modules.stochastic_actor import make_stochastic_actor
from torchrl_her.objectives.sac import make_sac_loss
from torchrl_her_recipes.components.learners.ddpg import DDPGBuilder


class SACBuilder(DDPGBuilder):
    """See :func:`~torchrl_her.make_sac_loss`; the critic is that of DDPG."""

    def actor(self, _runs: int) -> TensorDictModule:
        return make_stochastic_actor(
            self.widths, self.action_spec, hidden=self.options.hidden, in_keys=self.in_keys
        )

    def loss(
        self, actor: TensorDictModule, critic: TensorDictModule, rewards: tuple[float, float]
    ) -> LossModule:
        return make_sac_loss(actor, critic, action_spec=self.action_spec, gamma=self.options.gamma)

    def epsilon(self) -> dict[str, float]:
        """None: the policy explores by itself."""
        return {"start": 0.0, "decay": 1.0, "end": 0.0}
