"""The algorithms by name, and the goal strategies: both are checked before torch is imported."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from torchrl_her_recipes.config.options import AUTO, REGISTERED, what_there_is

STRATEGIES = ("future", "final", "episode")  # goal strategies that come with the library
RECENT = ("actual", "achieved")  # sources of goals besides strategies: those of recent episodes
_STRATEGY_REGISTRY = "torchrl_her.goals.strategies"

Instructive = Literal["simultaneous", "sequential"]


@dataclass(frozen=True, kw_only=True)
class Algorithm:
    """One way to use hindsight on top of a learner.

    Args:
        name: the name that recipes take.
        hindsight: whether virtual rows are written at all.
        filter_achieved: whether virtual goals that were already achieved are left out.
        instructive: how virtual goals are weighted by their instructiveness (IBS): "simultaneous" by
            q* - q, so that a goal counts less the more often it was written; "sequential" by q* alone;
            None for equal weights.
        curriculum: whether runs learn the layers of a curriculum (CHER).
        weights: a function that makes other weights, as ``module:function``. It is called once for each run,
            gets the recipe of that run alone (``recipe.run.seed`` is its seed) and the environment, and
            returns new :class:`~torchrl_her.GoalWeights`.
        reads: the options of the groups ``ibs`` and ``novelty`` that this function reads, as in
            ``"novelty.memory"``; the others are refused. None if it may read all of them.
        summary: one line for people.
    """

    name: str
    hindsight: bool = True
    filter_achieved: bool = False
    instructive: Instructive | None = None
    curriculum: bool = False
    weights: str = ""
    reads: tuple[str, ...] | None = None
    summary: str = ""


# Weights by novelty.
_RARE: dict[str, Any] = {
    "weights": "torchrl_her_recipes.components.novelty:rare_goals",
    "reads": ("novelty.sharpness", "novelty.memory"),
}
_RND: dict[str, Any] = {
    "weights": "torchrl_her_recipes.components.novelty:network_novelty",
    "reads": ("novelty.sharpness",),
}

ALGORITHMS: dict[str, Algorithm] = {
    algorithm.name: algorithm
    for algorithm in (
        Algorithm(name="no_hindsight", hindsight=False, summary="the learner alone"),
        Algorithm(name="her", summary="hindsight experience replay"),
        Algorithm(
            name="filtered_her",
            filter_achieved=True,
            summary="HER without virtual goals that were achieved already",
        ),
        Algorithm(
            name="her_ibs",
            instructive="simultaneous",
            summary="HER that prefers instructive goals: weights q* - q",
        ),
        Algorithm(
            name="filtered_her_ibs",
            filter_achieved=True,
            instructive="simultaneous",
            summary="Filtered-HER that prefers instructive goals",
        ),
        Algorithm(
            name="her_ibs_sequential",
            instructive="sequential",
            summary="HER with weights q* alone; prioritized replay does the rest",
        ),
        Algorithm(
            name="filtered_her_rare",
            filter_achieved=True,
            summary="Filtered-HER that prefers goals with few others around them",
            **_RARE,
        ),
        Algorithm(
            name="filtered_her_rnd",
            filter_achieved=True,
            summary="Filtered-HER that prefers goals new to a network (RND)",
            **_RND,
        ),
        Algorithm(
            name="cher", curriculum=True, filter_achieved=True, summary="Filtered-HER with a curriculum: CHER"
        ),
        Algorithm(
            name="cher_ibs",
            curriculum=True,
            filter_achieved=True,
            instructive="simultaneous",
            summary="CHER that prefers instructive goals in the layers that say so",
        ),
        Algorithm(
            name="cher_rare",
            curriculum=True,
            filter_achieved=True,
            summary="CHER that prefers goals with few others around them",
            **_RARE,
        ),
        Algorithm(
            name="cher_rnd",
            curriculum=True,
            filter_achieved=True,
            summary="CHER that prefers goals new to a network (RND)",
            **_RND,
        ),
        Algorithm(name="unfiltered_cher", curriculum=True, summary="CHER without the filter"),
        Algorithm(
            name="unfiltered_cher_ibs",
            curriculum=True,
            instructive="simultaneous",
            summary="CHER that prefers instructive goals, without the filter",
        ),
    )
}


_UNRESOLVED = Algorithm(name=AUTO, filter_achieved=True)  # until the environment tells which one it is


def register_algorithm(algorithm: Algorithm) -> None:
    """Makes an algorithm known by its name.

    Raises:
        ValueError: the name is taken.
    """
    if algorithm.name in ALGORITHMS:
        raise ValueError(f"there is an algorithm {algorithm.name!r} already")
    ALGORITHMS[algorithm.name] = algorithm


def get_algorithm(name: str) -> Algorithm:
    """The algorithm of a name; for ``auto`` what all that it may become have in common.

    Raises:
        ValueError: there is none; the message lists those that there are.

    Example:
        >>> get_algorithm("her").filter_achieved
        False
    """
    if name == AUTO:
        return _UNRESOLVED
    if name not in ALGORITHMS:
        raise ValueError(
            f"unknown algorithm {name!r}{what_there_is(name, ALGORITHMS, 'algorithms')}{REGISTERED}"
        )
    return ALGORITHMS[name]


def check_strategy(name: str) -> None:
    """Refuses a goal strategy that does not exist.

    Other strategies exist only if the library was imported to register them. So if it was not imported,
    the names that it comes with are all there are, and it need not be imported for the check.

    Raises:
        ValueError: it does not exist; the message lists those that do.
    """
    known = _known_strategies()
    if name not in known:
        hint = what_there_is(name, known, "strategies") + REGISTERED
        if name in RECENT:
            hint = f", which looks beyond the own episode: write goal_sources='{{{name}: 4}}'"
        raise ValueError(f"unknown goal strategy {name!r}{hint}")


def check_goal_sources(sources: object) -> dict[str, int]:
    """Checks how many virtual goals come from where.

    Example:
        >>> check_goal_sources({"future": 2, "actual": 2})
        {'future': 2, 'actual': 2}
    """
    example = "as in goal_sources='{future: 2, actual: 2}'"
    if not isinstance(sources, Mapping) or not sources:
        raise ValueError(f"goal_sources must be numbers of goals by source, {example}, got {sources!r}")
    known = [*_known_strategies(), *RECENT]
    for name, number in sources.items():
        if isinstance(name, str) and ":" in name and number is None:  # YAML took it for a name
            raise ValueError(f"goal_sources needs a space behind each colon, {example}, got {dict(sources)}")
        if name not in known:
            raise ValueError(
                f"unknown goal source {name!r}{what_there_is(name, known, 'sources')}{REGISTERED}"
            )
        if not isinstance(number, int) or isinstance(number, bool) or number < 1:
            raise ValueError(f"goal_sources.{name} must be a whole number of at least 1, got {number!r}")
    return dict(sources)


def _known_strategies() -> list[str]:
    registry = sys.modules.get(_STRATEGY_REGISTRY)
    return list(STRATEGIES if registry is None else registry.STRATEGIES)
