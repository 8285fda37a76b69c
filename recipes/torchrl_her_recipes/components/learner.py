"""Base class of builders, each of which makes the networks, exploration and loss of one learner."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import nn
from torchrl.objectives import LossModule
from torchrl.objectives.utils import TargetNetUpdater

from torchrl_her.curriculum.guide import GuidedExploration
from torchrl_her.modules.averaging import PolicyAverage
from torchrl_her.modules.exploration import DecayingEpsilon, Exploration
from torchrl_her.modules.normalization import RunningNorm
from torchrl_her.modules.normalized import NormalizedPolicy
from torchrl_her.objectives.cloning import Cloning

Networks = tuple[TensorDictModule, list[TensorDictModule]]


@dataclass(kw_only=True)
class Agent:
    """The components of a run that act and learn; see :class:`~torchrl_her_recipes.Components`."""

    actor: TensorDictModuleBase
    critic: TensorDictModule | None
    exploration: Exploration
    policy: TensorDictModuleBase
    loss: LossModule
    optimizer: torch.optim.Optimizer
    target: TargetNetUpdater | None
    norm: RunningNorm | None = None
    average: PolicyAverage | None = None
    guide: GuidedExploration | None = None


@dataclass(frozen=True, kw_only=True)
class AgentShape:
    """Inputs, outputs and types of the networks of one run, or of several runs side by side.

    Attributes:
        task: Name of the task, for messages.
        widths: Width of each entry that networks read, by its key; networks concatenate them in this order.
        action_spec: Spec of the actions of one environment.
        rewards: Least and greatest reward; infinite if rewards have no bounds.
        runs: Number of runs.
        dtype: Type of the weights.
    """

    task: str
    widths: dict[str, int]
    action_spec: Any
    rewards: tuple[float, float] = (-1.0, 0.0)
    runs: int = 1
    dtype: torch.dtype = torch.float32


def acting(actor: TensorDictModuleBase, norm: RunningNorm | None) -> TensorDictModuleBase:
    """Returns an actor that reads raw observations and goals, and normalizes them if ``norm`` is given."""
    return actor if norm is None else NormalizedPolicy(actor, norm)


class LearnerBuilder(ABC):
    """Builds networks, exploration and loss of a learner. Each learner has a subclass.

    Args:
        options: Options of the learner.
        shape: Inputs and outputs of its networks.

    Keyword Args:
        generators: Random generators, one for each run; None for torch's global generator.
        cloning: Settings for behavior cloning of demonstrations in the loss; None without cloning.
    """

    def __init__(
        self,
        options: Any,
        shape: AgentShape,
        *,
        generators: Sequence[torch.Generator] | None = None,
        cloning: Cloning | None = None,
    ) -> None:
        self.options, self.shape, self.generators, self.cloning = options, shape, generators, cloning
        self.in_keys, self.widths = list(shape.widths), list(shape.widths.values())
        self.action_spec, self.dtype = shape.action_spec, shape.dtype

    @property
    def bounds(self) -> tuple[float, float] | None:
        """Least and greatest reward, by which targets are clamped; None if they are not clamped."""
        return self.shape.rewards if getattr(self.options, "clamp_targets", True) else None

    @abstractmethod
    def networks(self, runs: int) -> Networks:
        """Makes the actor and the critics of ``runs`` runs side by side."""

    def norm(self) -> RunningNorm | None:
        """Makes the statistics for normalizing inputs, empty at first; None if inputs are not normalized."""
        options = self.options
        if not options.normalize:
            return None
        return RunningNorm(
            dict(self.shape.widths),
            runs=self.shape.runs,
            clip=options.normalize_clip,
            least_std=options.normalize_least_std,
        )

    def player(self, runs: int) -> TensorDictModule:
        """Makes the actor of ``runs`` runs. Override this if an actor can be made without critics."""
        return self.networks(runs)[0]

    def greedy(self, actor: TensorDictModule) -> nn.Module:
        """Returns the module to export, which maps tensors (observation, goal) to the greedy action.

        Args:
            actor: actor of a single run, from :meth:`player`; the result shares its weights.

        Raises:
            ValueError: the actor writes other entries than the action; its builder must override this method.
        """
        if list(actor.out_keys) != ["action"]:
            raise ValueError(
                f"a policy of learner={self.options.name} cannot be exported: its actor must write only "
                f"the action, but writes {', '.join(map(str, actor.out_keys))}; override "
                f"{type(self).__name__}.greedy"
            )
        return actor.module

    @abstractmethod
    def loss(self, actor: TensorDictModule, critics: Sequence[TensorDictModule]) -> LossModule:
        """Makes the TorchRL loss that trains the networks.

        Args:
            actor: actor from :meth:`networks`.
            critics: critics from :meth:`networks`.
        """

    def exploration(self) -> Exploration:
        """Makes the module that turns greedy actions into exploring ones; override for discrete actions."""
        spec = self.action_spec
        return DecayingEpsilon(
            spec.low, spec.high, generators=self.generators, **self.epsilon(), **self.action_noise()
        )

    def epsilon(self) -> dict[str, float]:
        """Returns the start, the decay and the end of epsilon, as arguments of the exploration module."""
        options = self.options
        return {"start": options.epsilon_start, "decay": options.epsilon_decay, "end": options.epsilon_end}

    def action_noise(self) -> dict[str, float]:
        """Returns the options for noise and uniform actions, except options that the learner lacks."""
        names = {"noise": "action_noise", "uniform_share": "uniform_share"}
        return {to: getattr(self.options, name) for to, name in names.items() if hasattr(self.options, name)}
