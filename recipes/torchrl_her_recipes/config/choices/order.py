"""Options of the orders in which stages are learned; functions in ``components.curricula`` make orders."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from torchrl_her_recipes.config.choices.kind import Choice, Kind
from torchrl_her_recipes.config.options import Needs, option

_MAKERS = "torchrl_her_recipes.components.curricula"


@dataclass(frozen=True, kw_only=True)
class Order(Choice):
    """Order in which the stages of a curriculum are learned.

    The maker takes the options and the :class:`~torchrl_her.Curriculum`, and by keyword the number of
    ``runs`` and their random ``generators``. It returns a :class:`~torchrl_her.CurriculumProgress`, or an
    :class:`~torchrl_her.curriculum.EpisodeStages` if each episode has a stage of its own. An order may have
    the options ``every_stage``, which stores episodes for every stage if episodes have stages,
    ``lower_share``, the share of them that it stores for stages below the last, ``relay``, with which the
    stages of the greedy policy act in turn, and ``stage_epsilon``, the epsilon with which a run begins a
    stage (1 without this option).
    """


ORDER = Kind("order", Order, default="threshold")


@ORDER.register
@dataclass(frozen=True, kw_only=True)
class Threshold(Order):
    """Trains stage after stage, each until it is learned."""

    name = "threshold"
    maker = f"{_MAKERS}:make_threshold"

    window: int = option(20, "number of greedy episodes whose mean success decides a stage's end", at_least=1)
    success_threshold: float = option(0.9, "mean success at which a stage ends", above=0, at_most=1)
    stage_epochs: int = option(0, "epochs after which a stage ends in any case; 0: no limit", at_least=0)
    stage_epsilon: float = option(1.0, "epsilon of exploration when a stage begins", at_least=0, at_most=1)


@dataclass(frozen=True, kw_only=True)
class _ByEpisode(Order):
    needs: ClassVar[Needs] = (("every_stage", bool, "lower_share"),)

    every_stage: bool = option(
        False, "whether each transition is stored for every stage, not just the stage of its episode"
    )
    lower_share: float = option(
        1.0,
        "share of the episodes that every_stage stores for the stages below the last, besides their own; "
        "the smaller, the more of each batch trains the task itself",
        at_least=0,
        at_most=1,
    )
    relay: bool = option(
        False,
        "whether the greedy policy acts in each step as in the stage after the last one whose goal is "
        "achieved, and not always as in the last stage",
    )


@ORDER.register
@dataclass(frozen=True, kw_only=True)
class AllAtOnce(_ByEpisode):
    """Draws the stage of each episode at random."""

    name = "all_at_once"
    maker = f"{_MAKERS}:make_all_at_once"

    task_share: float | None = option(
        None,
        "share of the episodes that are played in the last stage; if None, all stages are equally probable",
        at_least=0,
        at_most=1,
    )


@ORDER.register
@dataclass(frozen=True, kw_only=True)
class Teacher(_ByEpisode):
    """Draws stages of episodes, mostly those whose success changes (Matiisen et al., 2017)."""

    name = "teacher_student"
    maker = f"{_MAKERS}:make_teacher"

    progress_memory: float = option(
        200.0, "number of later episodes of a stage that lower an episode's weight to 1 / e", above=0
    )
    even_share: float = option(
        0.2, "share of the episodes whose stage is drawn with equal probabilities", above=0, at_most=1
    )
    least_progress: float = option(
        0.02, "added to the change of each stage's success, so that changes by chance count little", above=0
    )
