"""Drawing virtual goals: candidates times weights times filter, then k draws for each transition.

For transition t of an episode of length T, the goal achieved by transition t' is drawn with
probability proportional to ``candidate(t, t') * weight(g_t') * keep(t, t')``. Plain HER, filtered
HER, directed HER and their combinations differ in the factors alone. All functions work on
episodes padded to a common horizon T and take any leading batch shape.
"""

from __future__ import annotations

from typing import Literal, get_args

import torch
from torch import Tensor

Strategy = Literal["future", "final", "episode"]

_NARROW = 1e3  # greatest weight over the least one for which float32 draws them to a thousandth


def check_strategy(strategy: str) -> None:
    """Raises a ValueError that lists the strategies if there is no such one."""
    if strategy not in get_args(Strategy):
        known = ", ".join(get_args(Strategy))
        raise ValueError(f"unknown goal strategy {strategy!r}; the strategies are {known}")


def window(strategy: Strategy, time: Tensor, lengths: Tensor) -> tuple[Tensor, Tensor]:
    """Where the candidates of transitions begin, and where they end.

    Transition t' achieves the goal of the state that it leads to, so ``future`` (t' >= t) never
    looks at the past, and ``final`` is the goal of the episode's last state. Andrychowicz et al.,
    Hindsight Experience Replay, 2017, section 4.5.

    Args:
        strategy: ``"future"``, ``"final"`` or ``"episode"`` (any of the same episode).
        time: [...] int64, the transitions t.
        lengths: [...] int64, lengths of their episodes; broadcast against it.

    Returns:
        ``(first, end)``, [...] each: the candidates are ``first <= t' < end``.

    Raises:
        ValueError: an unknown strategy.

    Example:
        >>> first, end = window("future", torch.tensor([0, 1]), torch.tensor(2))
        >>> first.tolist(), end.tolist()
        ([0, 1], [2, 2])
    """
    check_strategy(strategy)
    time, end = torch.broadcast_tensors(time, lengths)
    first = {"future": time, "final": end - 1, "episode": torch.zeros_like(time)}[strategy]
    return first, end


def candidates(strategy: Strategy, lengths: Tensor, horizon: int) -> Tensor:
    """Which achieved goals a transition may take as its virtual goal: see :func:`window`.

    Args:
        strategy: ``"future"``, ``"final"`` or ``"episode"`` (any of the same episode).
        lengths: [...] int64, lengths of the episodes.
        horizon: T, the length to which they are padded.

    Returns:
        [..., T, T] of bool, indexed by (t, t'); False wherever t or t' is padding.

    Raises:
        ValueError: an unknown strategy.

    Example:
        >>> candidates("future", torch.tensor(2), 3).int().tolist()
        [[1, 1, 0], [0, 1, 0], [0, 0, 0]]
    """
    time = torch.arange(horizon, device=lengths.device)
    inside = time < lengths.unsqueeze(-1)
    return between(*window(strategy, time, lengths.unsqueeze(-1)), horizon) & inside.unsqueeze(-1)


def between(first: Tensor, end: Tensor, horizon: int) -> Tensor:
    """The candidates of :func:`window` as a mask [..., T], T being the horizon."""
    time = torch.arange(horizon, device=first.device)
    return (time >= first.unsqueeze(-1)) & (time < end.unsqueeze(-1))


def combine(candidate: Tensor, weight: Tensor | None = None, keep: Tensor | None = None) -> Tensor:
    """The product of the factors: how likely each goal is to be drawn, not normalised.

    Args:
        candidate: [..., T] of bool, from :func:`candidates` or ``between``.
        weight: [..., T], how useful each achieved goal is, at least 0; None for all alike.
        keep: [..., T] of bool, the filter; None to keep all. All are broadcast against each other.

    Returns:
        [..., T] of float.

    Example:
        >>> combine(torch.tensor([[True, True], [False, True]]), torch.tensor([1.0, 3.0])).tolist()
        [[1.0, 3.0], [0.0, 3.0]]
    """
    if keep is not None:
        candidate = candidate & keep
    if weight is None:
        return candidate.float()
    return candidate * weight


def draw_alike(first: Tensor, end: Tensor, k: int, *, generator: torch.Generator | None = None) -> Tensor:
    """Draws k goals, with replacement, for each transition, all its candidates being equally likely.

    The same as :func:`draw` from a table of candidates, without the table: its size is that of
    the transitions times the horizon.

    Args:
        first: [...] int64, the first candidate.
        end: [...] int64, behind the last one; above ``first``.
        k: number of draws.
        generator: source of the random numbers.

    Returns:
        [..., k] of int64, the transition that achieved the goal.

    Example:
        >>> draw_alike(torch.tensor([5, 7]), torch.tensor([6, 8]), 3).tolist()
        [[5, 5, 5], [7, 7, 7]]
    """
    u = torch.rand(*first.shape, k, device=first.device, generator=generator)
    return first.unsqueeze(-1) + (u * (end - first).unsqueeze(-1)).long()


def draw_weighted(
    weight: Tensor, first: Tensor, end: Tensor, k: int, *, generator: torch.Generator | None = None
) -> Tensor:
    """Draws k goals, with replacement, for each transition, by weights of the goals alone.

    The same as :func:`draw` from a table of weights of candidates, without the table: all transitions
    of an episode look up their draws in one running sum.

    Args:
        weight: [..., T], at least 0, of each goal of an episode.
        first: [..., n] int64, the first candidate of each transition.
        end: [..., n] int64, behind the last one; above ``first``.
        k: number of draws.
        generator: source of the random numbers.

    Returns:
        [..., n, k] of int64, the transition that achieved the goal. Where all candidates have weight 0
        it is one of them all the same: look at the weights of what was drawn.

    Example:
        >>> weight = torch.tensor([1.0, 0.0, 2.0, 5.0])
        >>> draw_weighted(weight, torch.tensor([1, 3]), torch.tensor([3, 4]), 2).tolist()
        [[2, 2], [3, 3]]
    """
    # Differences of a running sum in float32 drown weights that are far from the greatest.
    wide = weight.numel() > 0 and bool(weight.max() > _NARROW * weight.min())
    cumulative = torch.nn.functional.pad((weight.double() if wide else weight).cumsum(-1), (1, 0))
    low, high = cumulative.gather(-1, first), cumulative.gather(-1, end)
    u = torch.rand(*first.shape, k, dtype=cumulative.dtype, device=first.device, generator=generator)
    mass = low.unsqueeze(-1) + u * (high - low).unsqueeze(-1)
    # 32 bits are enough, and take half the time
    index = torch.searchsorted(cumulative, mass.flatten(-2), right=True, out_int32=True).view_as(mass)
    # u * mass can round up to a weight of 0 at the window's end, and beyond it
    low, high = (bound.int().unsqueeze(-1) for bound in (first + 1, end))
    return index.clamp_(low, high).long() - 1


def draw(likelihood: Tensor, k: int, *, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
    """Draws k goals, with replacement, for each transition.

    Args:
        likelihood: [..., T], at least 0, from :func:`combine`.
        k: number of draws.
        generator: source of the random numbers.

    Returns:
        ``(index, valid)``: [..., k] of int64, the transition that achieved the goal, and [...] of
        bool, False where all candidates of a transition have likelihood 0 (its indices then mean
        nothing).

    Example:
        >>> index, valid = draw(torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]), 2)
        >>> index[0].tolist(), valid.tolist()
        ([2, 2], [True, False])
    """
    cumulative = likelihood.cumsum(-1)
    total = cumulative[..., -1:]
    u = torch.rand(*total.shape[:-1], k, dtype=total.dtype, device=total.device, generator=generator)
    # u * total can round up to total itself, beyond the last goal that may be drawn
    mass = torch.minimum(u * total, torch.nextafter(total, torch.zeros_like(total)))
    index = torch.searchsorted(cumulative, mass, right=True)
    return index.clamp_(max=likelihood.shape[-1] - 1), total.squeeze(-1) > 0
