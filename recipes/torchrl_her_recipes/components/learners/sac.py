"""Builder of SAC, and of REDQ, which is SAC with other defaults."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.objectives import LossModule

from torchrl_her.modules.networks import NetworkShape
from torchrl_her.modules.stochastic_actor import (
    SquashedLocation,
    StochasticActorNet,
    make_stochastic_actor,
)
from torchrl_her.objectives.sac import make_sac_loss
from torchrl_her_recipes.components.learners.ddpg import DDPGBuilder


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
        """Bounds as of other learners; clamping raises an error if the task's rewards have no bounds."""
        if self.options.clamp_targets and not all(map(math.isfinite, self.shape.rewards)):
            raise ValueError(
                f"clamp_targets=true has no effect on {self.shape.task}, whose rewards have no bounds: "
                "leave it out"
            )
        return super().bounds

    def epsilon(self) -> dict[str, float]:
        """Returns no schedule: the policy explores by itself."""
        return {"start": 0.0, "decay": 1.0, "end": 0.0}
