"""Choices of the order of stages, with their options; the makers are in :mod:`..components.curricula`."""

from __future__ import annotations

from dataclasses import dataclass

from torchrl_her_recipes.config.choices.kind import Choice, Kind
from torchrl_her_recipes.config.options import option

_MAKERS = "torchrl_her_recipes.components.curricula"


@dataclass(frozen=True, kw_only=True)
class Order(Choice):
    """Order in which the stages of a curriculum are learned.

    The maker takes the options and the :class:`~torchrl_her.Curriculum`, and by keyword ``runs`` and
    ``generators`` (of random numbers, one for each run). It returns the
    :class:`~torchrl_her.CurriculumProgress` of the runs, or :class:`~torchrl_her.curriculum.EpisodeStages` if
    each episode has a stage of its own. In the latter case, an option ``every_stage`` that is true stores
    transitions for every stage. When a run begins a stage, epsilon starts at the option ``stage_epsilon``,
    or at 1 if the order has no such option.
    """


ORDER = Kind("order", Order, default="threshold")


@ORDER.register
@dataclass(frozen=True, kw_only=True)
class Threshold(Order):
    """Trains stage after stage, each until it is learned."""

    name = "threshold"
    maker = f"{_MAKERS}:make_threshold"

    window: int = option(20, "a stage ends by the mean success of this many greedy episodes", at_least=1)
    success_threshold: float = option(0.9, "mean success at which a stage ends", above=0, at_most=1)
    stage_epochs: int = option(0, "epochs after which a stage ends, learned or not; 0 for never", at_least=0)
    stage_epsilon: float = option(1.0, "epsilon of exploration when a stage begins", at_least=0, at_most=1)


@dataclass(frozen=True, kw_only=True)
class _ByEpisode(Order):
    every_stage: bool = option(
        False, "whether a transition is stored for every stage, not only for its episode's stage"
    )


@ORDER.register
@dataclass(frozen=True, kw_only=True)
class AllAtOnce(_ByEpisode):
    """Each episode is played in any of the stages."""

    name = "all_at_once"
    maker = f"{_MAKERS}:make_all_at_once"

    task_share: float | None = option(
        None,
        "share of the episodes that are played in the last stage; all stages alike if None",
        at_least=0,
        at_most=1,
    )


@ORDER.register
@dataclass(frozen=True, kw_only=True)
class Teacher(_ByEpisode):
    """Episodes prefer stages whose success changes (Matiisen et al., 2017)."""

    name = "teacher_student"
    maker = f"{_MAKERS}:make_teacher"

    progress_memory: float = option(
        200.0, "episodes of a stage after which one counts 1 / e of what it counted at first", above=0
    )
    even_share: float = option(
        0.2, "share of the episodes that are drawn from all stages alike", above=0, at_most=1
    )
    least_progress: float = option(
        0.02, "added to the change of each stage's success, so that chance alone prefers none", above=0
    )
