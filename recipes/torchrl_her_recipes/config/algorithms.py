"""Table of the algorithms by name, and checks of the names of goal strategies, without importing torch."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass
from functools import partial

from torchrl_her_recipes.config.options import AUTO, REGISTERED, what_there_is

STRATEGIES = ("future", "final", "episode")  # goal strategies that come with the library
RECENT = ("actual", "achieved")  # sources that take virtual goals from recent episodes, unlike strategies
_STRATEGY_REGISTRY = "torchrl_her.goals.strategies"


@dataclass(frozen=True)
class Algorithm:
    """A named combination of hindsight, filter, goal weights and curriculum, usable with any learner.

    Args:
        name: value of the recipe's option ``algo``.
        summary: one-line description for users.

    Keyword Args:
        virtual: whether transitions with virtual goals are stored at all.
        filter: whether virtual goals that were achieved before the action are left out.
        weights: name of the weights of virtual goals; None if the recipe chooses them.
        curriculum: whether runs learn the stages of a curriculum (CHER).
    """

    name: str
    summary: str = ""
    _: KW_ONLY
    virtual: bool = True
    filter: bool = False
    weights: str | None = None
    curriculum: bool = False


_filtered = partial(Algorithm, filter=True)
_cher = partial(Algorithm, curriculum=True, filter=True)
_unfiltered_cher = partial(Algorithm, curriculum=True)

_IBS = "prefers instructive goals"
_RARE = "prefers goals with few others around them"
_RND = "prefers goals new to a network (RND)"

ALGORITHMS: dict[str, Algorithm] = {
    algorithm.name: algorithm
    for algorithm in (
        Algorithm("no_hindsight", "the learner alone", virtual=False, weights="none"),
        Algorithm("her", "hindsight experience replay"),
        _filtered("filtered_her", "HER without virtual goals that were achieved already"),
        Algorithm("her_ibs", f"HER that {_IBS}: weights q* - q", weights="ibs"),
        _filtered("filtered_her_ibs", f"Filtered-HER that {_IBS}", weights="ibs"),
        Algorithm(
            "her_ibs_sequential",
            "HER that prefers goals of the task: weights q*; for prioritized replay",
            weights="ibs_sequential",
        ),
        _filtered("filtered_her_rare", f"Filtered-HER that {_RARE}", weights="rare"),
        _filtered("filtered_her_rnd", f"Filtered-HER that {_RND}", weights="rnd"),
        _cher("cher", "Filtered-HER with a curriculum: CHER"),
        _cher("cher_ibs", f"CHER that {_IBS} in the stages that say so", weights="ibs"),
        _cher("cher_rare", f"CHER that {_RARE}", weights="rare"),
        _cher("cher_rnd", f"CHER that {_RND}", weights="rnd"),
        _unfiltered_cher("unfiltered_cher", "CHER without the filter"),
        _unfiltered_cher("unfiltered_cher_ibs", f"CHER that {_IBS}, without the filter", weights="ibs"),
    )
}


_UNRESOLVED = Algorithm(name=AUTO, filter=True)  # stands for ``auto`` until the environment is known


def register_algorithm(algorithm: Algorithm) -> None:
    """Registers an algorithm by its name.

    Raises:
        ValueError: the name is taken by an algorithm that is not equal.
    """
    if ALGORITHMS.get(algorithm.name, algorithm) != algorithm:
        raise ValueError(f"there is an algorithm {algorithm.name!r} already")
    ALGORITHMS[algorithm.name] = algorithm


def get_algorithm(name: str) -> Algorithm:
    """Returns the algorithm with this name; for ``auto``, a placeholder that stands for filtered_her or cher.

    Raises:
        ValueError: no algorithm has this name; the message lists the algorithms.

    Example:
        >>> get_algorithm("her").filter
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
    """Raises a ValueError for an unknown goal strategy.

    Users must import the library to register a strategy. If the library has not been imported, only its
    built-in strategies can exist, so that this check need not import it.

    Raises:
        ValueError: the strategy does not exist; the message lists the strategies.
    """
    known = _known_strategies()
    if name not in known:
        hint = what_there_is(name, known, "strategies") + REGISTERED
        if name in RECENT:
            hint = f", which looks beyond the episode: write goal_sources='{{{name}: 4}}'"
        raise ValueError(f"unknown goal strategy {name!r}{hint}")


def check_goal_sources(sources: object) -> dict[str, int]:
    """Checks a mapping from sources of virtual goals to numbers of goals, and returns it as a dict.

    Example:
        >>> check_goal_sources({"future": 2, "actual": 2})
        {'future': 2, 'actual': 2}
    """
    example = "as in goal_sources='{future: 2, actual: 2}'"
    if not isinstance(sources, Mapping) or not sources:
        raise ValueError(f"goal_sources must be numbers of goals by source, {example}, got {sources!r}")
    known = [*_known_strategies(), *RECENT]
    for name, number in sources.items():
        if isinstance(name, str) and ":" in name and number is None:  # YAML needs a space behind the colon
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
