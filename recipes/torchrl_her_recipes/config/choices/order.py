"""Orders of layers by name: the options of each, whose makers are in :mod:`..components.curricula`."""

from __future__ import annotations

from dataclasses import dataclass

from torchrl_her_recipes.config.choices.kind import Choice, Kind
from torchrl_her_recipes.config.options import option

_MAKERS = "torchrl_her_recipes.components.curricula"


@dataclass(frozen=True, kw_only=True)
class Order(Choice):
    """Order in which the layers of a curriculum are learned.

    The maker takes the options and the :class:`~torchrl_her.Curriculum`, and by keyword ``runs`` and
    ``generators`` (of random numbers, one for each run). It returns the
    :class:`~torchrl_her.CurriculumProgress` of the runs, or :class:`~torchrl_her.curriculum.EpisodeLayers` if
    each episode has a layer of its own; with a true option ``every_layer``, transitions are then stored for
    every layer. A run that begins a layer explores with the epsilon of the option
    ``layer_epsilon``, or with 1 if the order has no such option.
    """


ORDER = Kind("order", Order, default="threshold")


@ORDER.register
@dataclass(frozen=True, kw_only=True)
class Threshold(Order):
    """Trains layer after layer, each until it is learned."""

    name = "threshold"
    maker = f"{_MAKERS}:make_threshold"

    window: int = option(20, "a layer ends by the mean success of this many greedy episodes", at_least=1)
    success_threshold: float = option(0.9, "mean success at which a layer ends", above=0, at_most=1)
    layer_epochs: int = option(0, "epochs after which a layer ends, learned or not; 0 for never", at_least=0)
    layer_epsilon: float = option(1.0, "epsilon of exploration when a layer begins", at_least=0, at_most=1)


@dataclass(frozen=True, kw_only=True)
class _ByEpisode(Order):
    every_layer: bool = option(
        False, "whether a transition is stored for every layer, not for that of its episode alone"
    )


@ORDER.register
@dataclass(frozen=True, kw_only=True)
class AllAtOnce(_ByEpisode):
    """Each episode is played in any of the layers."""

    name = "all_at_once"
    maker = f"{_MAKERS}:make_all_at_once"

    task_share: float | None = option(
        None,
        "share of the episodes that are played in the last layer; all layers alike if None",
        at_least=0,
        at_most=1,
    )


@ORDER.register
@dataclass(frozen=True, kw_only=True)
class Teacher(_ByEpisode):
    """Episodes prefer layers whose success changes (Matiisen et al., 2017)."""

    name = "teacher_student"
    maker = f"{_MAKERS}:make_teacher"

    progress_memory: float = option(
        200.0, "episodes of a layer after which one counts 1 / e of what it counted at first", above=0
    )
    even_share: float = option(
        0.2, "share of the episodes that are drawn from all layers alike", above=0, at_most=1
    )
    least_progress: float = option(
        0.02, "added to the change of each layer's success, so that chance alone prefers none", above=0
    )
