"""Options of the sources of training goals; functions in ``components.goals.behavior`` make the sources."""

from __future__ import annotations

from dataclasses import dataclass

from torchrl_her_recipes.config.choices.kind import Choice, Kind
from torchrl_her_recipes.config.choices.weights import IBS as IBSWeights
from torchrl_her_recipes.config.options import option

_MAKERS = "torchrl_her_recipes.components.goals.behavior"


@dataclass(frozen=True, kw_only=True)
class Behavior(Choice):
    """Goals that training episodes try to achieve (behavior goals)."""


BEHAVIOR = Kind("behavior", Behavior, default="real")


@BEHAVIOR.register
@dataclass(frozen=True, kw_only=True)
class Real(Behavior):
    """The task's own goals."""

    name = "real"


@dataclass(frozen=True, kw_only=True)
class Proposed(Behavior):
    """Base class of choices that replace the task's goal, in some episodes, by a goal achieved earlier.

    The maker takes these options and returns a :class:`~torchrl_her.behavior.GoalProposal`. Its keyword
    arguments:

    - ``learner``: options of the learner;
    - ``runs``: number of runs;
    - ``rewards``: rewards of a missed and of an achieved goal;
    - ``space``: space of the task's goals; only for options that derive from ``Equal`` weights, else None;
    - ``values``: function that makes the :class:`~torchrl_her.behavior.GoalValues` of the agent.
    """

    real_share: float = option(
        0.5, "share of the episodes that keep the task's own goals", at_least=0, at_most=1
    )
    goal_memory: int = option(50_000, "number of the newest achieved goals that are remembered", at_least=1)


@BEHAVIOR.register
@dataclass(frozen=True, kw_only=True)
class UniformAchieved(Proposed):
    """Any goal that was achieved before, with equal probability."""

    name = "uniform_achieved"
    maker = f"{_MAKERS}:make_uniform"


@dataclass(frozen=True, kw_only=True)
class _OneOfSome(Proposed):
    candidates: int = option(100, "number of achieved goals drawn, one of which is proposed", at_least=1)


@BEHAVIOR.register
@dataclass(frozen=True, kw_only=True)
class IBS(IBSWeights, _OneOfSome):
    """Goals that the task often has (q*) and episodes seldom get (q): weights q* - q."""

    name = "ibs"
    maker = f"{_MAKERS}:make_ibs"


@BEHAVIOR.register
@dataclass(frozen=True, kw_only=True)
class Mega(_OneOfSome):
    """Rare goals that the critic considers achievable (Pitis et al., 2020)."""

    name = "mega"
    maker = f"{_MAKERS}:make_mega"

    cutoff: float = option(-3.0, "initial lower bound of a proposed goal's value, for rewards of -1 and 0")


@BEHAVIOR.register
@dataclass(frozen=True, kw_only=True)
class Discover(_OneOfSome):
    """Achievable goals towards the task's goal (Diaz-Bone et al., 2025)."""

    name = "discover"
    maker = f"{_MAKERS}:make_discover"
