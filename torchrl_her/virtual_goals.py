"""Drawing virtual goals: candidates times weights times filter, then k draws for each transition.

For transition t of an episode of length T, the goal achieved by transition t' is drawn with
probability proportional to ``candidate(t, t') * weight(g_t') * keep(t, t')``. Plain HER, filtered
HER, directed HER and their combinations differ in the factors alone. All functions work on
episodes padded to a common horizon and take any leading batch shape.
"""

from __future__ import annotations

from typing import Literal, get_args

import torch
from torch import Tensor

Strategy = Literal["future", "final", "episode"]


def check_strategy(strategy: str) -> None:
    """Raises a ValueError that lists the strategies if there is no such one."""
    if strategy not in get_args(Strategy):
        known = ", ".join(get_args(Strategy))
        raise ValueError(f"unknown goal strategy {strategy!r}; the strategies are {known}")


def candidates(strategy: Strategy, lengths: Tensor, horizon: int) -> Tensor:
    """Which achieved goals a transition may take as its virtual goal.

    Transition t' achieves the goal of the state that it leads to, so ``future`` (t' >= t) never
    looks at the past, and ``final`` is the goal of the episode's last state. Andrychowicz et al.,
    Hindsight Experience Replay, 2017, section 4.5.

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
    check_strategy(strategy)
    time = torch.arange(horizon, device=lengths.device)
    inside = time < lengths.unsqueeze(-1)
    if strategy == "future":
        return inside.unsqueeze(-2) & (time >= time.unsqueeze(-1))  # where t' is inside, so is t <= t'
    if strategy == "final":
        return inside.unsqueeze(-1) & (time == lengths.unsqueeze(-1) - 1).unsqueeze(-2)
    return inside.unsqueeze(-1) & inside.unsqueeze(-2)


def combine(candidate: Tensor, weight: Tensor | None = None, keep: Tensor | None = None) -> Tensor:
    """The product of the factors: how likely each goal is to be drawn, not normalised.

    Args:
        candidate: [..., T, T] of bool, from :func:`candidates`.
        weight: [..., T], how useful each achieved goal is, at least 0; None for all alike.
        keep: [..., T, T] of bool, the filter; None to keep all.

    Returns:
        [..., T, T] of float.

    Example:
        >>> combine(torch.tensor([[True, True], [False, True]]), torch.tensor([1.0, 3.0])).tolist()
        [[1.0, 3.0], [0.0, 3.0]]
    """
    if keep is not None:
        candidate = candidate & keep
    if weight is None:
        return candidate.float()
    return candidate * weight.unsqueeze(-2)


def draw_alike(
    strategy: Strategy, lengths: Tensor, horizon: int, k: int, *, generator: torch.Generator | None = None
) -> Tensor:
    """Draws k goals, with replacement, for each transition, all its candidates being equally likely.

    The same as :func:`draw` from the table of :func:`candidates`, without making the table, whose
    size grows with the square of the horizon.

    Args:
        strategy: as of :func:`candidates`.
        lengths: [...] int64, lengths of the episodes.
        horizon: T, the length to which they are padded.
        k: number of draws.
        generator: source of the random numbers.

    Returns:
        [..., T, k] of int64, the transition that achieved the goal; means nothing where t is padding.

    Raises:
        ValueError: an unknown strategy.

    Example:
        >>> draw_alike("final", torch.tensor(3), 3, 2).tolist()
        [[2, 2], [2, 2], [2, 2]]
    """
    check_strategy(strategy)
    time = torch.arange(horizon, device=lengths.device)
    last = lengths.unsqueeze(-1) - 1
    first = {"future": time, "final": last, "episode": torch.zeros_like(time)}[strategy]
    span = (last - first + 1).unsqueeze(-1)
    u = torch.rand(*lengths.shape, horizon, k, device=lengths.device, generator=generator)
    return first.unsqueeze(-1) + (u * span).long()


def draw(likelihood: Tensor, k: int, *, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
    """Draws k goals, with replacement, for each transition.

    Args:
        likelihood: [..., T, T], at least 0, from :func:`combine`.
        k: number of draws.
        generator: source of the random numbers.

    Returns:
        ``(index, valid)``: [..., T, k] of int64, the transition that achieved the goal, and
        [..., T] of bool, False where all candidates of a transition have likelihood 0 (its
        indices then mean nothing).

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
