"""SAC."""

from __future__ import annotations

from tensordict.nn import TensorDictModule
from torchrl.objectives import LossModule

from torchrl_her.modules.networks import make_critic
from torchrl_her.modules.stochastic_actor import make_stochastic_actor
from torchrl_her.objectives.sac import make_sac_loss
from torchrl_her_recipes.components.learner import LearnerBuilder, Networks


class SACBuilder(LearnerBuilder):
    """See :func:`~torchrl_her.make_sac_loss`."""

    def networks(self, runs: int) -> Networks:
        options, spec = self.options, self.action_spec
        actor = make_stochastic_actor(self.widths, spec, hidden=options.hidden, in_keys=self.in_keys)
        critic = make_critic(
            self.widths,
            spec.shape[-1],
            hidden=options.hidden,
            normalize=options.batch_norm,
            runs=runs,
            in_keys=self.in_keys,
        )
        return actor.to(self.dtype), critic.to(self.dtype)

    def loss(
        self, actor: TensorDictModule, critic: TensorDictModule, rewards: tuple[float, float]
    ) -> LossModule:
        return make_sac_loss(actor, critic, action_spec=self.action_spec, gamma=self.options.gamma)

    def epsilon(self) -> dict[str, float]:
        """None: the policy explores by itself."""
        return {"start": 0.0, "decay": 1.0, "end": 0.0}
