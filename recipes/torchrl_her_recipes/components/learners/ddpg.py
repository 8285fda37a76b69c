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
        options, actions = self.options, self.action_spec.shape[-1]
        actor = make_actor(self.widths, actions, hidden=options.hidden, runs=runs, in_keys=self.in_keys)
        critic = make_critic(
            self.widths,
            actions,
            hidden=options.hidden,
            normalize=options.batch_norm,
            runs=runs,
            in_keys=self.in_keys,
        )
        return actor.to(self.dtype), critic.to(self.dtype)

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
