"""Goal sources: the number of virtual goals that each transition gets from each source."""

from __future__ import annotations

from collections.abc import Mapping
from difflib import get_close_matches
from numbers import Integral

from torchrl_her.goals.strategies import RECENT, STRATEGIES, Strategy, strategy_name

GoalSources = Mapping[Strategy, int]


def check_goal_sources(sources: GoalSources) -> dict[Strategy, int]:
    """Checks the number of virtual goals that each transition gets from each source.

    A source is a goal strategy, which gives goals of the transition's own episode, or one of two that look
    beyond it: ``"actual"``, the desired goals of recent episodes, and ``"achieved"``, the goals that were
    achieved in recent episodes.

    Args:
        sources: the number of goals, at least 1, of each source.

    Returns:
        A new dictionary of the same numbers as plain ``int``.

    Raises:
        ValueError: there is no source, an unknown one, or a number below 1.
        TypeError: ``sources`` is not a mapping from sources to numbers.

    Example:
        >>> check_goal_sources({"future": 2, "actual": 2})
        {'future': 2, 'actual': 2}
    """
    if not isinstance(sources, Mapping):
        raise TypeError(f"goal_sources must be numbers by source, as in {{'future': 4}}, got {sources!r}")
    if not sources:
        raise ValueError("goal_sources needs at least one source, as in {'future': 4}; k=0 asks for no goals")
    checked: dict[Strategy, int] = {}
    for source, number in sources.items():
        _check_source(source)
        if not isinstance(number, Integral) or isinstance(number, bool) or number < 1:
            raise ValueError(
                f"goal_sources must give whole numbers of at least 1, got {number!r} for "
                f"{strategy_name(source)!r}"
            )
        checked[source] = int(number)
    return checked


def sources_name(sources: GoalSources) -> str:
    """Returns the name of goal sources for a report.

    Example:
        >>> sources_name({"future": 2, "actual": 2})
        'future: 2, actual: 2'
    """
    return ", ".join(f"{strategy_name(source)}: {number}" for source, number in sources.items())


def _check_source(source: Strategy) -> None:
    known = [*STRATEGIES, *RECENT]
    if not callable(source) and source not in known:
        nearest = get_close_matches(str(source), known, n=1)
        hint = f"; did you mean {nearest[0]!r}?" if nearest else ""
        raise ValueError(f"unknown goal source {source!r}; the sources are {', '.join(known)}{hint}")
