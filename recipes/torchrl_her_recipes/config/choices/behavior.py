"""Choices of behavior goals, with their options; the makers are in :mod:`..components.goals.behavior`."""

from __future__ import annotations

from dataclasses import dataclass

from torchrl_her_recipes.config.choices.kind import Choice, Kind
from torchrl_her_recipes.config.choices.weights import IBS as IBSWeights
from torchrl_her_recipes.config.options import option

_MAKERS = "torchrl_her_recipes.components.goals.behavior"


@dataclass(frozen=True, kw_only=True)
class Behavior(Choice):
    """Which goals the episodes of training ask for (behavior goals)."""


BEHAVIOR = Kind("behavior", Behavior, default="real")


@BEHAVIOR.register
@dataclass(frozen=True, kw_only=True)
class Real(Behavior):
    """The task's own goals."""

    name = "real"


@dataclass(frozen=True, kw_only=True)
class Proposed(Behavior):
    """Base class of choices that, in some of the episodes, ask for goals that were achieved before.

    The maker takes the options and the function ``goals``. It calls ``goals`` with ``weights``, ``factors``
    and the like, and returns the :class:`~torchrl_her.behavior.BehaviorGoals` that this makes. Keyword
    arguments of the maker:

    - ``learner``: options of the learner;
    - ``runs``: number of runs;
    - ``rewards``: rewards of a missed and of an achieved goal;
    - ``space``: space of the task's goals, for options of IBS;
    - ``values``: function that makes the :class:`~torchrl_her.behavior.GoalValues` of the agent.
    """

    real_share: float = option(
        0.5, "share of the episodes that keep the task's own goals", at_least=0, at_most=1
    )
    goal_memory: int = option(50_000, "newest achieved goals that are remembered", at_least=1)


@BEHAVIOR.register
@dataclass(frozen=True, kw_only=True)
class UniformAchieved(Proposed):
    """Any achieved goal."""

    name = "uniform_achieved"
    maker = f"{_MAKERS}:make_uniform"


@dataclass(frozen=True, kw_only=True)
class _OneOfSome(Proposed):
    candidates: int = option(100, "achieved goals of which one is proposed", at_least=1)


@BEHAVIOR.register
@dataclass(frozen=True, kw_only=True)
class IBS(IBSWeights, _OneOfSome):
    """Instructive goals: weights q* - q."""

    name = "ibs"
    maker = f"{_MAKERS}:make_ibs"


@BEHAVIOR.register
@dataclass(frozen=True, kw_only=True)
class Mega(_OneOfSome):
    """Rare goals that the critic believes in (Pitis et al., 2020)."""

    name = "mega"
    maker = f"{_MAKERS}:make_mega"

    cutoff: float = option(-3.0, "lowest value of a proposed goal at first, for rewards of -1 and 0")


@BEHAVIOR.register
@dataclass(frozen=True, kw_only=True)
class Discover(_OneOfSome):
    """Achievable goals towards the task's goal (Diaz-Bone et al., 2025)."""

    name = "discover"
    maker = f"{_MAKERS}:make_discover"
