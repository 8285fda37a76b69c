"""Builders of the learners, to which :mod:`torchrl_her_recipes.config.choices.learners` refers by name."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, cast

from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import QValueActor
from torchrl.objectives import LossModule

from torchrl_her.modules.exploration import DecayingEpsilonGreedy, Exploration
from torchrl_her.modules.networks import NetworkShape, make_actor, make_critic
from torchrl_her.modules.q_actor import BestAction, QNet, make_q_actor
from torchrl_her.modules.stochastic_actor import SquashedLocation, StochasticActorNet, make_stochastic_actor
from torchrl_her.objectives.actor_terms import ActorTerms
from torchrl_her.objectives.ddpg import make_ddpg_loss
from torchrl_her.objectives.dqn import make_dqn_loss
from torchrl_her.objectives.sac import make_sac_loss
from torchrl_her.objectives.targets import Targets
from torchrl_her.objectives.td3 import make_td3_loss
from torchrl_her.objectives.tqc import make_tqc_loss
from torchrl_her_recipes.components.devices import place_of
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
        """Makes a deterministic actor for ``runs`` runs side by side."""
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
        """Makes one critic for ``runs`` runs side by side."""
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
        """Returns the arguments that are common to the losses of all learners with continuous actions."""
        return {
            "targets": Targets(gamma=self.options.gamma, reward_range=self.bounds),
            "terms": ActorTerms(
                action_penalty=self.options.action_penalty,
                saturation_penalty=getattr(self.options, "saturation_penalty", 0.0),
                cloning=self.cloning,
            ),
            "reduction": "none",
        }


class TD3Builder(DDPGBuilder):
    """Builds TD3, see :func:`~torchrl_her.objectives.make_td3_loss`, with the networks of DDPG."""

    def loss(self, actor: TensorDictModule, critics: Sequence[TensorDictModule]) -> LossModule:
        return make_td3_loss(
            actor,
            critics,
            action_spec=self.action_spec.to(place_of(actor)),
            target_critics=self.options.target_critics,
            target_noise=self.options.target_noise,
            generators=self.generators,
            **self.loss_options(),
        )


class SACBuilder(DDPGBuilder):
    """Builds SAC, see :func:`~torchrl_her.objectives.make_sac_loss`, with the critics of DDPG."""

    def actor(self, runs: int) -> TensorDictModule:
        return make_stochastic_actor(
            self.widths,
            self.action_spec,
            shape=NetworkShape(**self.options.actor_shape),
            runs=runs,
            in_keys=self.in_keys,
            generators=self.generators,
        )

    def greedy(self, actor: TensorDictModule) -> nn.Module:
        net = next(module for module in actor.modules() if isinstance(module, StochasticActorNet))
        spec = self.action_spec
        return SquashedLocation(net, spec.low.to(self.dtype), spec.high.to(self.dtype))

    def loss(self, actor: TensorDictModule, critics: Sequence[TensorDictModule]) -> LossModule:
        return make_sac_loss(
            actor, critics, target_critics=self.options.target_critics, **self.loss_options()
        )

    def loss_options(self) -> dict[str, Any]:
        return super().loss_options() | {"temperature": self.options.temperature}

    @property
    def bounds(self) -> tuple[float, float] | None:
        """Least and greatest reward for clamping targets, or None; raises an error if they are infinite."""
        if self.options.clamp_targets and not all(map(math.isfinite, self.shape.rewards)):
            raise ValueError(
                f"clamp_targets=true has no effect on {self.shape.task}, whose rewards have no bounds: "
                "leave it out"
            )
        return super().bounds

    def epsilon(self) -> dict[str, float]:
        """Returns an epsilon of 0 throughout: the stochastic policy explores by itself."""
        return {"start": 0.0, "decay": 1.0, "end": 0.0}


class TQCBuilder(SACBuilder):
    """Builds TQC, see :func:`~torchrl_her.objectives.make_tqc_loss`, with the actor of SAC."""

    @property
    def outputs(self) -> int:
        return int(self.options.quantiles)

    def loss(self, actor: TensorDictModule, critics: Sequence[TensorDictModule]) -> LossModule:
        return make_tqc_loss(
            actor, critics, dropped_quantiles=self.options.dropped_quantiles, **self.loss_options()
        )


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
