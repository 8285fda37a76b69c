"""Draws goals for transitions from lists of candidates, in proportion to candidate times weight times filter.

A line is a list of goals, of an episode or of a pool that many transitions share. A transition may take its
goal from the part of a line that the strategy allows.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from torchrl_her.goals.factors import between, combine, draw, draw_uniformly, draw_weighted
from torchrl_her.goals.weights import checked_weights
from torchrl_her.randomness import RunDraws

# Largest number of likelihoods [transitions, W] that are computed at once, to bound memory.
LIKELIHOODS = 1 << 17
# Number of times that goals refused by the filter are drawn again, if lines of candidates are long.
TRIES = 8

Index = Tensor | slice
Keep = Callable[[Index, Tensor], Tensor]


class Candidates(NamedTuple):
    """Goals that transitions [n] may take, before weights and filter.

    Attributes:
        goals: [p, g], the goals of all lines.
        table: [L, W] int64, positions in ``goals``; shorter lines are padded with their last position.
        line: [n] int64, ascending: the line of each transition.
        first, end: [n] int64: the places in its line that a transition may take, ``first <= place < end``.
    """

    goals: Tensor
    table: Tensor
    line: Tensor
    first: Tensor
    end: Tensor

    def of(self, some: Tensor) -> Candidates:
        """Returns the candidates of the transitions at the positions ``some``, in order."""
        return self._replace(line=self.line[some], first=self.first[some], end=self.end[some])


def choose_goals(
    candidates: Candidates,
    k: int,
    *,
    weights: Callable[[Tensor], Tensor] | None,
    keep: Keep | None,
    draws: RunDraws,
    tries: int = 0,
    redraw: bool = True,
) -> tuple[Tensor, Tensor]:
    """Draws k goals for each transition, with replacement, by candidate times weight times filter.

    To save work, goals are proposed by candidate and weight alone. Goals that the filter refuses are replaced
    by new proposals, up to ``tries`` times. If a transition still has a refused goal, all its k goals are
    drawn again, from the likelihoods of all its candidates. The result follows the product of the three
    factors.

    Args:
        candidates: candidates of n transitions.
        k: number of draws.

    Keyword Args:
        weights: maps goals [L, W, g] to how useful each is, [L, W]; None for equal weights.
        keep: the filter. It takes transitions, as an index [m] or a slice, and c goals for each, [m, c, g].
            It returns which of these goals may be drawn, [m, c] of bool. None keeps all.
        draws: source of the random numbers.
        tries: how often refused goals are proposed again; saves time if lines are long and few are refused.
        redraw: False to leave out goals that the filter refuses, and draw no others in their place.

    Returns:
        ``(position, valid)``, [n, k] each: int64, positions in ``candidates.goals``, and bool, False where a
        position is meaningless: no goal may be drawn, or the drawn one was refused.

    Raises:
        ValueError: weights are negative or not finite.

    Example:
        >>> goals = torch.tensor([[0.0], [1.0], [2.0], [3.0]])
        >>> line = torch.tensor([[0, 1, 2, 3]])  # for two transitions; the second may take the last two
        >>> first, end = torch.tensor([0, 2]), torch.tensor([4, 4])
        >>> candidates = Candidates(goals, line, torch.tensor([0, 0]), first, end)
        >>> def even(which, goals):
        ...     return goals[..., 0] % 2 == 0
        >>> draws = RunDraws([torch.Generator().manual_seed(0)])
        >>> position, valid = choose_goals(candidates, 3, weights=None, keep=even, draws=draws)
        >>> position[1].tolist(), valid[1].tolist()
        ([2, 2, 2], [True, True, True])
    """
    goals, table, line, *_ = candidates
    width = table.shape[1]
    lines = None if weights is None else goals[table]
    weight = None if weights is None or lines is None else checked_weights(weights(lines), lines)
    index = _propose(candidates, k, weight, draws)
    valid = torch.ones_like(index, dtype=torch.bool)
    useless = weight is not None and not bool((weight > 0).all())
    begin = line * width  # start of each line in the flat table

    def test(which: Index, index: Tensor) -> Tensor:
        """Returns which of c proposed goals the filter rejects, for m transitions: [m, c] of bool."""
        at = begin[which].unsqueeze(-1) + index
        out = torch.zeros_like(at, dtype=torch.bool)
        if weight is not None and useless:
            out |= weight.take(at) == 0
        if keep is not None:
            out |= ~keep(which, goals[table.take(at)])
        return out

    if keep is not None or useless:
        refused = test(slice(None), index)
        if not redraw:
            return table.take(begin.unsqueeze(-1) + index), ~refused
        for _ in range(tries):
            which, column = refused.nonzero(as_tuple=True)
            if len(which) == 0:
                break
            again = _propose(candidates.of(which), 1, weight, draws.of(which))
            index[which, column] = again.squeeze(-1)
            refused[which, column] = test(which, again).squeeze(-1)
        rest = refused.any(-1).nonzero().squeeze(-1)
        if len(rest) > 0:
            at_once = max(1, LIKELIHOODS // width)
            lines = goals[table] if lines is None else lines
            dtype = torch.float32 if weight is None else weight.dtype
            numbers = draws.of(rest)((len(rest), k), dtype, line.device)
            drawn = []
            for part, u in zip(rest.split(at_once), numbers.split(at_once), strict=True):
                likelihood = combine(
                    between(candidates.first[part], candidates.end[part], width),
                    None if weight is None else weight[line[part]],
                    None if keep is None else keep(part, lines[line[part]]),
                )
                drawn.append(draw(likelihood, k, generator=lambda *_, u=u: u))
            index[rest], drawable = (torch.cat(part) for part in zip(*drawn, strict=True))
            valid[rest] = drawable.unsqueeze(-1)
    return table.take(begin.unsqueeze(-1) + index), valid


def _propose(candidates: Candidates, k: int, weight: Tensor | None, draws: RunDraws) -> Tensor:
    """Draws k positions in the lines of n transitions, [n, k], without the filter."""
    _, _, line, first, end = candidates
    if weight is None:
        return draw_uniformly(first, end, k, generator=draws)
    n, counts = len(line), line.bincount(minlength=len(weight))
    longest = int(counts.max())
    whole = n == len(counts) * longest
    place = None if whole else torch.arange(n, device=line.device) - (counts.cumsum(0) - counts)[line]

    def by_line(x: Tensor) -> Tensor:
        """Arranges entries [n, ...] of transitions in one padded row per line, [L, longest, ...]."""
        if place is None:
            return x.reshape(len(counts), longest, *x.shape[1:])
        return x.new_zeros(len(counts), longest, *x.shape[1:]).index_put_((line, place), x)

    def numbers(_: tuple[int, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
        """Returns random numbers for transitions, and 0 for padding, whose size other lines determine."""
        return by_line(draws((n, k), dtype, device))

    drawn = draw_weighted(weight, by_line(first), by_line(end), k, generator=numbers)
    return drawn.flatten(0, 1) if place is None else drawn[line, place]
