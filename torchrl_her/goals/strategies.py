"""Goal strategies and sources: which achieved goals a transition may take, and how many from each source."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from difflib import get_close_matches
from numbers import Integral
from typing import Any

import torch
from torch import Tensor

StrategyFunction = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
Strategy = str | StrategyFunction
GoalSources = Mapping[Strategy, int]


def future(time: Tensor, lengths: Tensor) -> tuple[Tensor, Tensor]:
    """Candidates are the goals that this action and all later ones achieved."""
    return time, lengths


def final(_time: Tensor, lengths: Tensor) -> tuple[Tensor, Tensor]:
    """The candidate is the goal that the episode's last action achieved."""
    return lengths - 1, lengths


def episode(time: Tensor, lengths: Tensor) -> tuple[Tensor, Tensor]:
    """Candidates are all goals that were achieved in the episode, earlier ones too."""
    return torch.zeros_like(time), lengths


STRATEGIES: dict[str, StrategyFunction] = {"future": future, "final": final, "episode": episode}
_SAFE = tuple(STRATEGIES.values())  # these never leave the episode, so their candidates are not checked

_INTEGERS = (torch.int64, torch.int32, torch.int16, torch.int8, torch.uint8)

# Sources that are no strategies, since they take goals of other episodes: see ``check_goal_sources``.
RECENT = ("actual", "achieved")


def register_strategy(name: str, function: StrategyFunction) -> None:
    """Gives a goal strategy a name, which is then accepted wherever ``"future"`` is.

    A function can also be used without a name: ``HERWriter(reward_fn, strategy=function)``.

    Args:
        name: name of the strategy, not yet taken by another one.
        function: maps the steps of transitions and the lengths of their episodes, both [...] int64, to
            ``(first, end)``, both [...] int64: the candidates are the transitions ``first <= t' < end``.
            There must be at least one, and all must lie within the episode.

    Raises:
        ValueError: the name is empty, or taken by a function of another module or qualified name; a function
            that is defined again, as in a notebook, replaces the one before.
        TypeError: the function cannot be called.

    Example:
        >>> def next_two(time, lengths):
        ...     return time, torch.minimum(time + 2, lengths)
        >>> register_strategy("next_two", next_two)
        >>> get_strategy("next_two") is next_two
        True
        >>> del STRATEGIES["next_two"]  # for this example only
    """
    if not name:
        raise ValueError(f"a goal strategy needs a name, got {name!r}")
    if name in RECENT or _place_of(STRATEGIES.get(name, function)) != _place_of(function):
        names = ", ".join([*STRATEGIES, *RECENT])
        raise ValueError(f"the name {name!r} is taken by another goal strategy; taken are {names}")
    if not callable(function):
        raise TypeError(f"goal strategy {name!r} must be a function, got {function!r}")
    STRATEGIES[name] = function


def _place_of(function: StrategyFunction) -> tuple[Any, Any]:
    """Returns module and qualified name, which a function keeps if its module or cell runs again."""
    return getattr(function, "__module__", None), getattr(function, "__qualname__", function)


def get_strategy(strategy: Strategy) -> StrategyFunction:
    """Returns the function of a goal strategy that is given by its name or as a function.

    Raises:
        ValueError: there is no strategy of that name.

    Example:
        >>> first, end = get_strategy("future")(torch.tensor([0, 1]), torch.tensor([2, 2]))
        >>> first.tolist(), end.tolist()
        ([0, 1], [2, 2])
    """
    if callable(strategy):
        return strategy
    if strategy in STRATEGIES:
        return STRATEGIES[strategy]
    nearest = get_close_matches(str(strategy), STRATEGIES, n=1)
    hint = f"; did you mean {nearest[0]!r}?" if nearest else ""
    if strategy in RECENT:
        hint = f"; goals of other episodes are asked for by goal_sources={{{strategy!r}: 4}}"
    raise ValueError(f"unknown goal strategy {strategy!r}; the strategies are {', '.join(STRATEGIES)}{hint}")


def strategy_name(strategy: Strategy) -> str:
    """Returns the name of a strategy, or of its function, for a report.

    Example:
        >>> strategy_name("final"), strategy_name(future)
        ('final', 'future')
    """
    if isinstance(strategy, str):
        return strategy
    return getattr(strategy, "__name__", type(strategy).__name__)


def candidate_range(strategy: Strategy, time: Tensor, lengths: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the first candidate of each transition, and the end of its candidates.

    A candidate is a transition t' of the same episode. Its achieved goal is read from the state it leads
    to, so with ``"future"`` (t' >= t) no candidate was achieved before the action. Andrychowicz et al.,
    Hindsight Experience Replay, 2017, section 4.5.

    Args:
        strategy: ``"future"``, ``"final"``, ``"episode"`` (any transition of the episode), another name
            given to :func:`~torchrl_her.register_strategy`, or a function.
        time: [...] int64, the transitions' steps t, from 0.
        lengths: [...] int64, lengths of their episodes; broadcast against ``time``.

    Returns:
        ``(first, end)``, [...] each: the candidates are ``first <= t' < end``.

    Raises:
        ValueError: the strategy is unknown, or its function returns anything but two tensors of whole
            numbers, or gives a transition no candidate, or one outside of its episode.

    Example:
        >>> first, end = candidate_range("future", torch.tensor([0, 1]), torch.tensor(2))
        >>> first.tolist(), end.tolist()
        ([0, 1], [2, 2])
    """
    function = get_strategy(strategy)
    time, lengths = torch.broadcast_tensors(time, lengths)
    first, end = function(time, lengths)
    if not any(function is safe for safe in _SAFE):
        kinds = [getattr(edge, "dtype", edge) for edge in (first, end)]
        if not all(kind in _INTEGERS for kind in kinds):
            raise ValueError(
                f"goal strategy {strategy_name(strategy)!r} must return two int64 tensors, first and end, "
                f"got {kinds[0]} and {kinds[1]}"
            )
        first, end, _ = torch.broadcast_tensors(first, end, time)
        wrong = (time < lengths) & ((first < 0) | (first >= end) | (end > lengths))  # padding is ignored
        if bool(wrong.any()):
            t, length, low, high = (int(x[wrong][0]) for x in (time, lengths, first, end))
            raise ValueError(
                f"goal strategy {strategy_name(strategy)!r} gives step {t} of an episode of {length} the "
                f"candidates first={low}, end={high}, but 0 <= first < end <= {length} must hold"
            )
    return first, end


def check_goal_sources(sources: GoalSources) -> dict[Strategy, int]:
    """Checks the sources of :class:`~torchrl_her.HindsightOptions`, and makes their numbers plain ``int``.

    Raises:
        ValueError: there is no source, an unknown one, or a number below 1.
        TypeError: ``sources`` is not a mapping from sources to numbers.
    """
    if not isinstance(sources, Mapping):
        raise TypeError(f"goal_sources must map sources to numbers, as in {{'future': 4}}, got {sources!r}")
    if not sources:
        raise ValueError("goal_sources needs at least one source, as in {'future': 4}; k=0 asks for no goals")
    checked: dict[Strategy, int] = {}
    for source, number in sources.items():
        if not callable(source) and source not in (known := [*STRATEGIES, *RECENT]):
            nearest = get_close_matches(str(source), known, n=1)
            hint = f"; did you mean {nearest[0]!r}?" if nearest else ""
            raise ValueError(f"unknown goal source {source!r}; the sources are {', '.join(known)}{hint}")
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
