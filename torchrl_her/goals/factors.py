"""Drawing virtual goals: candidates times weights times filter, then k draws for each transition.

For transition t, a goal g is drawn with probability proportional to
``candidate(t, g) * weight(g) * keep(t, g)``. A strategy's candidates are goals that transitions t' of the
same episode achieved; other sources have a pool of goals of recent episodes, all of which are candidates.
Plain HER, filtered HER, instructive goals (IBS), goals of other episodes and their combinations differ only
in these factors. All functions work on episodes, or pools, padded to a common length T and take any leading
batch shape.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torchrl_her.goals.strategies import Strategy, candidate_range

# A generator, or a function that returns uniform numbers in [0, 1) for a shape, dtype and device.
Randomness = torch.Generator | Callable[[tuple[int, ...], torch.dtype, torch.device], Tensor] | None


def candidates(strategy: Strategy, lengths: Tensor, horizon: int) -> Tensor:
    """Returns a table of the achieved goals that each transition may take as its virtual goal.

    Args:
        strategy: a name or a function: see :func:`~torchrl_her.goals.candidate_range`.
        lengths: [...] int64, lengths of the episodes.
        horizon: T, the length to which they are padded.

    Returns:
        Mask [..., T, T], indexed by (t, t'): whether transition t may take the goal that t' achieved;
        False wherever t or t' is padding.

    Raises:
        ValueError: the strategy is unknown, or leaves the episode.

    Example:
        >>> candidates("future", torch.tensor(2), 3).int().tolist()
        [[1, 1, 0], [0, 1, 0], [0, 0, 0]]
    """
    time = torch.arange(horizon, device=lengths.device)
    inside = time < lengths.unsqueeze(-1)
    return between(*candidate_range(strategy, time, lengths.unsqueeze(-1)), horizon) & inside.unsqueeze(-1)


def between(first: Tensor, end: Tensor, horizon: int) -> Tensor:
    """Converts ranges from :func:`~torchrl_her.goals.candidate_range` to a mask [..., T] over a horizon T."""
    time = torch.arange(horizon, device=first.device)
    return (time >= first.unsqueeze(-1)) & (time < end.unsqueeze(-1))


def combine(candidate: Tensor, weight: Tensor | None = None, keep: Tensor | None = None) -> Tensor:
    """Multiplies candidates, weights and filter to the likelihood of each goal, not yet normalized.

    Args:
        candidate: [..., T] of bool, from :func:`~torchrl_her.goals.candidates` or ``between``.
        weight: [..., T], how useful each achieved goal is, at least 0; None for equal weights.
        keep: [..., T] of bool, the filter; None to keep all. All three arguments are broadcast together.

    Returns:

        Likelihoods [..., T], which are floating-point numbers.

    Example:
        >>> combine(torch.tensor([[True, True], [False, True]]), torch.tensor([1.0, 3.0])).tolist()
        [[1.0, 3.0], [0.0, 3.0]]
    """
    if keep is not None:
        candidate = candidate & keep
    if weight is None:
        return candidate.float()
    return candidate * weight


def _uniform(shape: tuple[int, ...], dtype: torch.dtype, device: torch.device, source: Randomness) -> Tensor:
    if source is None or isinstance(source, torch.Generator):
        return torch.rand(*shape, dtype=dtype, device=device, generator=source)
    return source(shape, dtype, device)


def draw_uniformly(first: Tensor, end: Tensor, k: int, *, generator: Randomness = None) -> Tensor:
    """Draws k goals for each transition, with replacement, all of its candidates being equally likely.

    The goals are distributed as :func:`~torchrl_her.goals.draw` draws them from a table of candidates. No
    table is made, as its size would be the number of transitions times the horizon.

    Args:
        first: [...] int64, the first candidate.
        end: [...] int64, one more than the last candidate; above ``first``.
        k: number of draws.
        generator: source of the random numbers, or a function (shape, dtype, device) that returns them.

    Returns:
        Steps [..., k] int64 of the transitions that achieved the drawn goals.

    Example:
        >>> draw_uniformly(torch.tensor([5, 7]), torch.tensor([6, 8]), 3).tolist()
        [[5, 5, 5], [7, 7, 7]]
    """
    u = _uniform((*first.shape, k), torch.get_default_dtype(), first.device, generator)
    return first.unsqueeze(-1) + (u * (end - first).unsqueeze(-1)).long()


def draw_weighted(
    weight: Tensor, first: Tensor, end: Tensor, k: int, *, generator: Randomness = None
) -> Tensor:
    """Draws k goals for each transition, with replacement, in proportion to the goals' weights.

    The goals are distributed as :func:`~torchrl_her.goals.draw` draws them from a table of the candidates'
    weights. No table is made: all transitions of an episode look up their draws in the same running sum.

    Args:
        weight: [..., T], the weight of each goal of an episode, at least 0.
        first: [..., n] int64, the first candidate of each transition.
        end: [..., n] int64, one more than the last candidate; above ``first``.
        k: number of draws.
        generator: source of the random numbers, or a function (shape, dtype, device) that returns them.

    Returns:
        Steps [..., n, k] int64 of the transitions that achieved the drawn goals. If all candidates have
        weight 0, one of them is drawn nevertheless, so check the weights of drawn goals.

    Example:
        >>> weight = torch.tensor([1.0, 0.0, 2.0, 5.0])
        >>> draw_weighted(weight, torch.tensor([1, 3]), torch.tensor([3, 4]), 2).tolist()
        [[2, 2], [3, 3]]
    """
    # In float32, differences of a running sum would lose weights that are far below the greatest.
    cumulative = torch.nn.functional.pad(weight.double().cumsum(-1), (1, 0))
    low, high = cumulative.gather(-1, first), cumulative.gather(-1, end)
    u = _uniform((*first.shape, k), cumulative.dtype, first.device, generator)
    mass = low.unsqueeze(-1) + u * (high - low).unsqueeze(-1)
    # 32-bit indices are enough, and take half the time
    index = torch.searchsorted(cumulative, mass.flatten(-2), right=True, out_int32=True).view_as(mass)
    # rounding may move u * mass beyond the last candidate whose weight is not 0
    low, high = (bound.int().unsqueeze(-1) for bound in (first + 1, end))
    return index.clamp_(low, high).long() - 1


def draw(likelihood: Tensor, k: int, *, generator: Randomness = None) -> tuple[Tensor, Tensor]:
    """Draws k goals for each transition, with replacement, in proportion to a table of likelihoods.

    Args:
        likelihood: [..., T], at least 0, from :func:`~torchrl_her.goals.combine`.
        k: number of draws.
        generator: source of the random numbers, or a function (shape, dtype, device) that returns them.

    Returns:
        ``(index, valid)``: steps [..., k] int64 of the transitions that achieved the drawn goals, and bool
        [...], False where all candidates of a transition have likelihood 0, so that its indices are
        meaningless.

    Example:
        >>> index, valid = draw(torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]), 2)
        >>> index[0].tolist(), valid.tolist()
        ([2, 2], [True, False])
    """
    cumulative = likelihood.cumsum(-1)
    total = cumulative[..., -1:]
    u = _uniform((*total.shape[:-1], k), total.dtype, total.device, generator)
    # u * total can round up to total itself, which lies beyond the last goal that may be drawn
    mass = torch.minimum(u * total, torch.nextafter(total, torch.zeros_like(total)))
    index = torch.searchsorted(cumulative, mass, right=True)
    return index.clamp_(max=likelihood.shape[-1] - 1), total.squeeze(-1) > 0
