"""DDPG."""

from __future__ import annotations

from tensordict.nn import TensorDictModule
from torchrl.objectives import LossModule

from torchrl_her.modules.networks import make_actor, make_critic
from torchrl_her.objectives.ddpg import make_ddpg_loss
from torchrl_her_recipes.components.learner import LearnerBuilder, Networks


class DDPGBuilder(LearnerBuilder):
    """See :func:`~torchrl_her.make_ddpg_loss`."""

    def networks(self, runs: int) -> Networks:
        return self.actor(runs).to(self.dtype), self.critic(runs).to(self.dtype)

    def actor(self, runs: int) -> TensorDictModule:
        """The deterministic actor of some runs side by side."""
        actions, hidden = self.action_spec.shape[-1], self.options.hidden
        return make_actor(self.widths, actions, hidden=hidden, runs=runs, in_keys=self.in_keys)

    def critic(self, runs: int) -> TensorDictModule:
        """Their critic."""
        return make_critic(
            self.widths,
            self.action_spec.shape[-1],
            hidden=self.options.hidden,
            normalize=self.options.batch_norm,
            runs=runs,
            in_keys=self.in_keys,
        )

    def loss(
        self, actor: TensorDictModule, critic: TensorDictModule, rewards: tuple[float, float]
    ) -> LossModule:
        return make_ddpg_loss(
            actor,
            critic,
            gamma=self.options.gamma,
            reward_range=rewards,
            action_penalty=self.options.action_penalty,
            reduction="none",
        )
