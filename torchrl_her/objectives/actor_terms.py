"""Terms of an actor's loss besides the values of its actions."""

from __future__ import annotations

from dataclasses import dataclass

from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives import LossModule

from torchrl_her.objectives.action_cost import action_cost
from torchrl_her.objectives.cloning import Cloning, with_cloning


@dataclass(frozen=True, kw_only=True)
class ActorTerms:
    """Terms that are added to an actor's loss: penalties on its actions, and behavior cloning.

    Args:
        action_penalty: weight of the action L2 penalty, see :func:`~torchrl_her.objectives.action_cost`.
        saturation_penalty: weight of the saturation penalty, which is for deterministic actors.
        cloning: options for cloning the actions of rows marked as demonstrations; None for no cloning.
    """

    action_penalty: float = 0.0
    saturation_penalty: float = 0.0
    cloning: Cloning | None = None

    def add_to(self, value: Tensor, loss: LossModule, action: Tensor, transitions: TensorDictBase) -> Tensor:
        """Adds the terms to the loss of an actor.

        Args:
            value: the actor's loss: the mean over all rows, or one number for each row.
            loss: TorchRL loss that has the actor.
            action: [..., a], the actor's actions, from -1 to 1.
            transitions: rows [...].
        """
        cost = action_cost(action, l2=self.action_penalty, saturation=self.saturation_penalty)
        value = value + (cost if value.ndim else cost.mean())
        return value if self.cloning is None else with_cloning(value, loss, self.cloning, transitions)
