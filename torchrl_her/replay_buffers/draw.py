"""Drawing the virtual goals of whole episodes."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import torch
from torch import Tensor

from torchrl_her.goals.factors import between, combine, draw, draw_alike, draw_weighted
from torchrl_her.goals.strategies import Strategy, candidate_range
from torchrl_her.goals.weights import GoalWeights, checked_weights
from torchrl_her.replay_buffers.episodes import Episodes
from torchrl_her.replay_buffers.options import Per

# Likelihoods of goals [transitions, T] that are held in memory at once.
LIKELIHOODS = 1 << 17

Keep = Callable[[Tensor, Tensor], Tensor]


def draw_goals(
    before: Tensor,
    after: Tensor,
    episodes: Episodes,
    k: int,
    *,
    strategy: Strategy = "future",
    weights: GoalWeights | None = None,
    keep: Keep | None = None,
    per: Per = "transition",
    generator: torch.Generator | None = None,
) -> tuple[Tensor, Tensor]:
    """Draws k virtual goals for each transition, or each episode, by strategy times weights times filter.

    To save work, goals are first proposed by strategy and weights alone. If the filter rejects one of a
    transition's k goals, all k are drawn again, from the likelihoods of all its candidates. The result still
    follows the product of the three factors.

    Args:
        before: [n, g], the goals that were achieved before the actions.
        after: [n, g], the goals that the actions achieved: the candidates.
        episodes: positions in ``before`` and ``after``.
        k: number of draws.

    Keyword Args:
        strategy: a name or a function, see :func:`~torchrl_her.goals.candidate_range`.
        weights: how useful each goal is; None for all alike.
        keep: the filter. It maps goals achieved before and goals wanted, [..., g] each and broadcast against
            each other, to bool [...]: which of them may be drawn; None for all.
        per: whether each transition gets k goals, or each episode: those of its first transition.
        generator: source of the random numbers.

    Returns:
        ``(source, goal_source)``, [V] each: the transitions to be relabeled, each of them k times, and those
        whose ``after`` is the goal. Transitions without a goal that may be drawn are left out.

    Raises:
        ValueError: weights are negative or not finite, or the strategy leaves an episode.

    Example:
        >>> walk = torch.arange(4.0).unsqueeze(-1)
        >>> episode = Episodes(rows=torch.tensor([[0, 1, 2]]), lengths=torch.tensor([3]))
        >>> source, goal_source = draw_goals(walk[:-1], walk[1:], episode, 2, strategy="final")
        >>> source.tolist(), goal_source.tolist()
        ([0, 0, 1, 1, 2, 2], [2, 2, 2, 2, 2, 2])
    """
    if per == "episode":
        real, episode = episodes.rows[:, 0], torch.arange(len(episodes.lengths), device=episodes.rows.device)
        time = torch.zeros_like(episode)
    else:
        real = episodes.rows[episodes.inside]
        episode, time = episodes.inside.nonzero(as_tuple=True)
    if k == 0 or len(real) == 0:
        return real[:0], real[:0]
    weight = None if weights is None or weights.alike else checked_weights(weights(after[episodes.rows]))
    index = _propose(episodes, episode, time, k, strategy, weight, generator)
    valid = torch.ones_like(real, dtype=torch.bool)
    begin = (episode * episodes.rows.shape[1]).unsqueeze(-1)  # of the episode in the flat table of rows
    refused = torch.zeros_like(index, dtype=torch.bool)
    if weight is not None and not bool((weight > 0).all()):
        refused |= weight.take(begin + index) == 0
    if keep is not None:
        refused |= ~keep(before[real].unsqueeze(1), after[episodes.rows.take(begin + index)])
    again = refused.any(-1).nonzero().squeeze(-1)
    if len(again) > 0:
        own_before, own_episode, own_time = before[real[again]], episode[again], time[again]
        likelihoods = _likelihoods(
            own_before, own_episode, own_time, after, episodes, strategy=strategy, weight=weight, keep=keep
        )
        drawn = [draw(likelihood, k, generator=generator) for likelihood in likelihoods]
        index[again], valid[again] = (torch.cat(part) for part in zip(*drawn, strict=True))
    source = real[valid].unsqueeze(-1).expand(-1, k).flatten()
    return source, episodes.rows.take(begin + index)[valid].flatten()


def _propose(
    episodes: Episodes,
    episode: Tensor,
    time: Tensor,
    k: int,
    strategy: Strategy,
    weight: Tensor | None,
    generator: torch.Generator | None,
) -> Tensor:
    """Goals [n, k] for transitions, by strategy and weights alone."""
    if weight is None:
        first, end = candidate_range(strategy, time, episodes.lengths[episode])
        return draw_alike(first, end, k, generator=generator)
    # Padding draws goals too, which are not used.
    steps = torch.arange(int(time.max()) + 1, device=weight.device)
    length = episodes.lengths.unsqueeze(-1)
    first, end = candidate_range(strategy, steps.minimum(length - 1), length)
    return draw_weighted(weight, first, end, k, generator=generator)[episode, time]


def _likelihoods(
    before: Tensor,
    episode: Tensor,
    time: Tensor,
    after: Tensor,
    episodes: Episodes,
    *,
    strategy: Strategy,
    weight: Tensor | None,
    keep: Keep | None,
) -> Iterator[Tensor]:
    """For some transitions, the likelihoods [n, T] of all goals of their episodes, piece by piece."""
    first, end = candidate_range(strategy, time, episodes.lengths[episode])
    goals = after[episodes.rows]
    horizon = goals.shape[1]
    for part in torch.arange(len(time), device=time.device).split(max(1, LIKELIHOODS // horizon)):
        own = episode[part]
        yield combine(
            between(first[part], end[part], horizon),
            None if weight is None else weight[own],
            None if keep is None else keep(before[part].unsqueeze(1), goals[own]),
        )
