"""The base class of builders of learners: networks, exploration and a TorchRL loss."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import nn
from torchrl.envs import EnvBase
from torchrl.objectives import LossModule
from torchrl.objectives.utils import TargetNetUpdater

from torchrl_her.curriculum.guide import GuidedExploration
from torchrl_her.modules.averaging import PolicyAverage
from torchrl_her.modules.exploration import DecayingEpsilon, Exploration
from torchrl_her.modules.normalization import RunningNorm
from torchrl_her.objectives.cloning import Cloning
from torchrl_her_recipes.config.recipe import Recipe

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


class LearnerBuilder(ABC):
    """Builds a learner for a recipe and an environment; a subclass for each learner.

    Args:
        recipe: of the run, or of several.
        env: tells the widths of observations, goals and actions.
        in_keys: the entries that the networks see.

    Attributes:
        options: the recipe's group of the learner's own options.
        device: where networks and losses are.
        generators: of each run's random numbers; None for torch's own.
        rewards: the least and the greatest that there can be; infinite if the task's is dense.
    """

    device = torch.device("cpu")
    rewards = (-1.0, 0.0)
    generators: Sequence[torch.Generator] | None = None

    def __init__(self, recipe: Recipe, env: EnvBase, in_keys: Sequence[str]) -> None:
        self.recipe, self.env, self.in_keys = recipe, env, in_keys
        self.options: Any = recipe.learner
        self.dtype: torch.dtype = getattr(torch, recipe.run.dtype)

    @property
    def widths(self) -> list[int]:
        """Widths of the entries that the networks see."""
        return [self.env.observation_spec[key].shape[-1] for key in self.in_keys]

    @property
    def action_spec(self) -> Any:
        """The actions of one environment."""
        return self.env.action_spec_unbatched.to(self.device)

    @property
    def bounds(self) -> tuple[float, float] | None:
        """The rewards whose returns targets are clamped to; None if they are not clamped."""
        return self.rewards if getattr(self.options, "clamp_targets", True) else None

    @abstractmethod
    def networks(self, runs: int) -> Networks:
        """The actor and the critics of some runs side by side."""

    def player(self, runs: int) -> TensorDictModule:
        """The actor alone; override this where critics need not be made for it."""
        return self.networks(runs)[0]

    def greedy(self, actor: TensorDictModule) -> nn.Module:
        """What an exported policy plays: (observation, goal), as tensors, to the greedy action.

        Args:
            actor: of a single run, from :meth:`player`; its weights are shared.

        Raises:
            ValueError: the actor writes more than the action. Then a builder overrides this.
        """
        if list(actor.out_keys) != ["action"]:
            raise ValueError(
                f"a policy of learner={self.recipe.learner.name} cannot be exported: its actor writes "
                f"{', '.join(map(str, actor.out_keys))} and not the action alone; override "
                f"{type(self).__name__}.greedy"
            )
        return actor.module

    @abstractmethod
    def loss(self, actor: TensorDictModule, critics: Sequence[TensorDictModule]) -> LossModule:
        """TorchRL's loss.

        Args:
            actor: from :meth:`networks`.
            critics: likewise.
        """

    @property
    def cloning(self) -> Cloning | None:
        """How the loss clones demonstrations; None if it does not."""
        own = self.recipe.demonstrations
        if not own.in_batches or own.bc_weight == 0:
            return None
        return Cloning(weight=own.bc_weight, q_filter=own.q_filter)

    def exploration(self) -> Exploration:
        """Turns greedy into exploring actions; here for continuous ones."""
        spec = self.action_spec
        return DecayingEpsilon(
            spec.low, spec.high, generators=self.generators, **self.epsilon(), **self.action_noise()
        )

    def epsilon(self) -> dict[str, float]:
        """The schedule of epsilon."""
        options = self.options
        return {"start": options.epsilon_start, "decay": options.epsilon_decay, "end": options.epsilon_end}

    def action_noise(self) -> dict[str, float]:
        """How exploring actions are drawn, where that is an option of the learner."""
        names = {"noise": "action_noise", "uniform_share": "uniform_share"}
        return {to: getattr(self.options, own) for to, own in names.items() if hasattr(self.options, own)}
