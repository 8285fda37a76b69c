"""Builder of TQC: networks, loss and exploration."""

from __future__ import annotations

from collections.abc import Sequence

from tensordict.nn import TensorDictModule
from torchrl.objectives import LossModule

from torchrl_her.objectives.tqc import make_tqc_loss
from torchrl_her_recipes.components.learners.sac import SACBuilder


class TQCBuilder(SACBuilder):
    """Builds TQC, see :func:`~torchrl_her.objectives.make_tqc_loss`, with the actor of SAC."""

    @property
    def outputs(self) -> int:
        return int(self.options.quantiles)

    def loss(self, actor: TensorDictModule, critics: Sequence[TensorDictModule]) -> LossModule:
        return make_tqc_loss(
            actor, critics, dropped_quantiles=self.options.dropped_quantiles, **self.loss_options()
        )
