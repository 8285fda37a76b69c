"""Builder of DDPG: networks, loss and exploration."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tensordict.nn import TensorDictModule
from torchrl.objectives import LossModule

from torchrl_her.modules.networks import NetworkShape, make_actor, make_critic
from torchrl_her.objectives.actor_terms import ActorTerms
from torchrl_her.objectives.ddpg import make_ddpg_loss
from torchrl_her.objectives.targets import Targets
from torchrl_her_recipes.components.learner import LearnerBuilder, Networks


class DDPGBuilder(LearnerBuilder):
    """Builds networks and loss of DDPG, see :func:`~torchrl_her.make_ddpg_loss`."""

    def networks(self, runs: int) -> Networks:
        actor = self.player(runs)
        critics = [self.critic(runs).to(self.dtype) for _ in range(getattr(self.options, "critics", 1))]
        return actor, critics

    def player(self, runs: int) -> TensorDictModule:
        return self.actor(runs).to(self.dtype)

    def actor(self, runs: int) -> TensorDictModule:
        """Returns the deterministic actor of some runs side by side."""
        return make_actor(
            self.widths,
            self.action_spec.shape[-1],
            shape=NetworkShape(**self.options.actor_shape),
            runs=runs,
            in_keys=self.in_keys,
        )

    @property
    def outputs(self) -> int:
        """Number of outputs of a critic."""
        return 1

    def critic(self, runs: int) -> TensorDictModule:
        """Returns one critic of some runs side by side."""
        return make_critic(
            self.widths,
            self.action_spec.shape[-1],
            shape=NetworkShape(**self.options.critic_shape),
            runs=runs,
            outputs=self.outputs,
            in_keys=self.in_keys,
        )

    def loss(self, actor: TensorDictModule, critics: Sequence[TensorDictModule]) -> LossModule:
        return make_ddpg_loss(actor, critics[0], **self.loss_options())

    def loss_options(self) -> dict[str, Any]:
        """Returns the options that losses of learners with continuous actions share."""
        return {
            "targets": Targets(gamma=self.options.gamma, reward_range=self.bounds),
            "terms": ActorTerms(
                action_penalty=self.options.action_penalty,
                saturation_penalty=getattr(self.options, "saturation_penalty", 0.0),
                cloning=self.cloning,
            ),
            "reduction": "none",
        }
