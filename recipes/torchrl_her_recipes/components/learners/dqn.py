"""Builder of DQN: networks, loss and exploration."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import QValueActor
from torchrl.objectives import LossModule

from torchrl_her.modules.exploration import DecayingEpsilonGreedy, Exploration
from torchrl_her.modules.networks import NetworkShape
from torchrl_her.modules.q_actor import BestAction, QNet, make_q_actor
from torchrl_her.objectives.dqn import make_dqn_loss
from torchrl_her.objectives.targets import Targets
from torchrl_her_recipes.components.learner import LearnerBuilder, Networks


class DQNBuilder(LearnerBuilder):
    """Builds networks and loss of double DQN, see :func:`~torchrl_her.objectives.make_dqn_loss`."""

    def networks(self, runs: int) -> Networks:
        actor, critic = make_q_actor(
            self.widths,
            self.action_spec.n,
            shape=NetworkShape(**self.options.critic_shape),
            runs=runs,
            in_keys=self.in_keys,
        )
        return actor.to(self.dtype), [critic]  # the critic shares the actor's weights

    def greedy(self, actor: TensorDictModule) -> nn.Module:
        return BestAction(next(module for module in actor.modules() if isinstance(module, QNet)))

    def loss(self, actor: TensorDictModule, critics: Sequence[TensorDictModule]) -> LossModule:
        return make_dqn_loss(
            cast(QValueActor, actor),
            targets=Targets(gamma=self.options.gamma, reward_range=self.bounds),
            reduction="none",
        )

    def exploration(self) -> Exploration:
        return DecayingEpsilonGreedy(self.action_spec.n, generators=self.generators, **self.epsilon())
