"""Drawing the virtual goals of whole episodes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_her.goals.factors import between, combine, draw, draw_alike, draw_weighted
from torchrl_her.goals.rewards import RewardFunction, missed
from torchrl_her.goals.strategies import Strategy, candidate_range
from torchrl_her.goals.weights import GoalWeights, WeightsOfRuns, checked_weights
from torchrl_her.replay_buffers.episodes import Episodes
from torchrl_her.replay_buffers.keys import TransitionKeys, entry_of
from torchrl_her.replay_buffers.options import HindsightOptions, Per
from torchrl_her.replay_buffers.runs.pieces import Piece
from torchrl_her.replay_buffers.runs.streams import Generators, uniform

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
    weights: Callable[[Tensor], Tensor] | None = None,
    keep: Keep | None = None,
    per: Per = "transition",
    generator: torch.Generator | None = None,
    runs: Tensor | None = None,
    generators: Generators | None = None,
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
        weights: maps goals [..., g] to how useful each is, [...], such as
            :class:`~torchrl_her.GoalWeights`; None for all alike.
        keep: the filter. It maps goals achieved before and goals wanted, [..., g] each and broadcast against
            each other, to bool [...]: which of them may be drawn; None for all.
        per: whether each transition gets k goals, or each episode: those of its first transition.
        generator: source of the random numbers.
        runs: [E] int64, ascending: which of R runs each episode is of, each with a generator of its own; None
            for a single one.
        generators: R of them, if there are ``runs``.

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
    alike = weights is None or (isinstance(weights, GoalWeights) and weights.alike)
    weight = None if weights is None or alike else checked_weights(weights(after[episodes.rows]))
    sources = [generator] if generators is None else generators
    draws = _Draws(sources, None if runs is None or len(sources) == 1 else runs[episode])
    index = _propose(episodes, episode, time, k, strategy, weight, draws)
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
        dtype = torch.float32 if weight is None else weight.dtype
        parts = iter(draws.of(again)((len(again), k), dtype, real.device).split(_at_once(episodes)))
        drawn = [draw(likelihood, k, generator=lambda *_: next(parts)) for likelihood in likelihoods]
        index[again], valid[again] = (torch.cat(part) for part in zip(*drawn, strict=True))
    source = real[valid].unsqueeze(-1).expand(-1, k).flatten()
    return source, episodes.rows.take(begin + index)[valid].flatten()


def draw_for_runs(
    rows: TensorDictBase,
    piece: Piece,
    reward_fn: RewardFunction,
    options: HindsightOptions,
    keys: TransitionKeys,
    *,
    weights: WeightsOfRuns | None,
    generators: Generators,
) -> tuple[Tensor, Tensor]:
    """Draws the virtual goals of episodes of several runs, each run with its own weights and generator.

    Args:
        rows: [n], collected transitions.
        piece: some episodes of them, of m runs.
        reward_fn: maps (achieved, desired) goals to (reward, terminated); the filter asks it.
        options: how many goals, and by which strategy and filter.
        keys: where entries are.

    Keyword Args:
        weights: of all runs; None for all goals alike.
        generators: m of them.

    Returns:
        ``(source, goal_source)``, as :func:`draw_goals` does.
    """
    episodes = piece.episodes
    if options.k == 0:  # then the batch may be without goals
        return episodes.lengths[:0], episodes.lengths[:0]
    own_weights = None
    if weights is not None:
        counts = piece.sums(torch.ones_like(episodes.lengths))
        own_weights = partial(weights, runs=piece.runs, counts=counts)
    keep = partial(missed, reward_fn, achieved_reward=options.achieved_reward)
    return draw_goals(
        entry_of(rows, keys.achieved),
        entry_of(rows, keys.next_achieved),
        episodes,
        options.k,
        strategy=options.strategy,
        weights=own_weights,
        keep=keep if options.filter_achieved else None,
        per=options.per,
        runs=piece.position,
        generators=generators,
    )


class _Draws:
    """Uniform numbers for transitions, from the generator of the run that each is of.

    Args:
        generators: R.
        run: [n], ascending; None for one run.
    """

    def __init__(self, generators: Generators, run: Tensor | None) -> None:
        self.generators, self.run = generators, run

    def of(self, some: Tensor) -> _Draws:
        """Those of some transitions, in order."""
        return self if self.run is None else _Draws(self.generators, self.run[some])

    def __call__(self, shape: tuple[int, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
        n, k = shape
        counts = [n] if self.run is None else self.run.bincount(minlength=len(self.generators)).tolist()
        return uniform(counts, k, self.generators, dtype=dtype, device=device)


def _propose(
    episodes: Episodes,
    episode: Tensor,
    time: Tensor,
    k: int,
    strategy: Strategy,
    weight: Tensor | None,
    draws: _Draws,
) -> Tensor:
    """Goals [n, k] for transitions, by strategy and weights alone."""
    if weight is None:
        first, end = candidate_range(strategy, time, episodes.lengths[episode])
        return draw_alike(first, end, k, generator=draws)
    steps = torch.arange(int(time.max()) + 1, device=weight.device)
    length = episodes.lengths.unsqueeze(-1)
    first, end = candidate_range(strategy, steps.minimum(length - 1), length)

    def padded(shape: tuple[int, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
        """Numbers for transitions alone: what is drawn must not depend on how far episodes are padded."""
        u = draws((len(time), k), dtype, device)
        if u.numel() == first.numel() * k:
            return u.view(shape)
        return torch.zeros(shape, dtype=dtype, device=device).index_put_((episode, time), u)

    return draw_weighted(weight, first, end, k, generator=padded)[episode, time]


def _at_once(episodes: Episodes) -> int:
    """Transitions for which the likelihoods of all goals are held in memory at once."""
    return max(1, LIKELIHOODS // episodes.rows.shape[1])


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
    for part in torch.arange(len(time), device=time.device).split(_at_once(episodes)):
        own = episode[part]
        yield combine(
            between(first[part], end[part], horizon),
            None if weight is None else weight[own],
            None if keep is None else keep(before[part].unsqueeze(1), goals[own]),
        )
