"""Draws the virtual goals of whole episodes."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchrl_her.checks import entry_of
from torchrl_her.goals.choose import TRIES, Candidates, Index, choose_goals
from torchrl_her.goals.rewards import Outcome, ends_at_goals, missed
from torchrl_her.goals.strategies import RECENT, Strategy, candidate_range
from torchrl_her.goals.weights import GoalWeights, WeightsOfRuns
from torchrl_her.randomness import Generators, RunDraws
from torchrl_her.replay_buffers.episodes import Episodes
from torchrl_her.replay_buffers.options import Per
from torchrl_her.replay_buffers.runs.pieces import Chunk
from torchrl_her.replay_buffers.runs.recent import RecentGoals

Keep = Callable[[Any, Tensor], Tensor]


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
) -> tuple[Tensor, Tensor]:
    """Draws k virtual goals for each transition, or each episode, by strategy times weights times filter.

    Goals come from the same episode; for goals of other episodes see :class:`~torchrl_her.HindsightOptions`.

    Args:
        before: [n, g], the goals that were achieved before the actions.
        after: [n, g], the goals that the actions achieved: the candidates.
        episodes: positions of the episodes' transitions in ``before`` and ``after``.
        k: number of draws.

    Keyword Args:
        strategy: a name or a function, see :func:`~torchrl_her.goals.candidate_range`.
        weights: maps goals [..., g] to how useful each is, [...], such as
            :class:`~torchrl_her.GoalWeights`; None for equal weights.
        keep: the filter: maps goals achieved before the actions and candidate goals, [..., g] each, which are
            broadcast, to bool [...]: whether the candidate may be drawn. None keeps all.
        per: whether each transition gets k goals, or each episode, drawn for its first transition.
        generator: source of the random numbers.

    Returns:
        ``(source, goal_source)``, [V] each: the transitions to be relabeled, each of them k times, and the
        transitions whose ``after`` is the goal. Transitions without a goal that may be drawn are left out.

    Raises:
        ValueError: weights are negative or not finite, or the strategy leaves an episode.

    Example:
        >>> walk = torch.arange(4.0).unsqueeze(-1)
        >>> episode = Episodes(rows=torch.tensor([[0, 1, 2]]), lengths=torch.tensor([3]))
        >>> source, goal_source = draw_goals(walk[:-1], walk[1:], episode, 2, strategy="final")
        >>> source.tolist(), goal_source.tolist()
        ([0, 0, 1, 1, 2, 2], [2, 2, 2, 2, 2, 2])
    """
    drawn = _Transitions.of(episodes, per)
    if k == 0 or len(drawn.row) == 0:
        return drawn.row[:0], drawn.row[:0]
    is_uniform = weights is None or (isinstance(weights, GoalWeights) and weights.is_uniform)
    index, valid = choose_goals(
        drawn.candidates(after, episodes, strategy),
        k,
        weights=None if is_uniform else weights,
        keep=drawn.filter(before, keep),
        draws=drawn.draws([generator], None),
    )
    return drawn.row.unsqueeze(-1).expand_as(index)[valid], index[valid]


def draw_for_runs(
    chunk: Chunk,
    *,
    weights: WeightsOfRuns | None,
    generators: Generators,
    recent: RecentGoals,
    times: int = 1,
) -> tuple[Tensor, Tensor, list[int]]:
    """Draws the virtual goals of episodes of several runs, each run with its own weights and generator.

    Goals are drawn for each source separately, by candidate times weight times filter. The candidates of a
    source are goals of the same episode, or goals of recent episodes that the run remembers.

    Args:
        chunk: episodes of m runs.

    Keyword Args:
        weights: weights of all runs; None for equal weights.
        generators: m generators, one for each run.
        recent: the goals of recent episodes of all runs, the episodes of ``chunk`` included.
        times: factor by which the options' number of goals of the same episode is multiplied.

    Returns:
        ``(source, goals, relabeled)``: the transitions [V] that get a virtual goal, one after the other, each
        up to k times; the goals [V, g]; and m numbers of transitions that got goals of their own episode.
    """
    rows, piece, reward_fn, options = chunk.rows, chunk.piece, chunk.reward_fn, chunk.options
    episodes = piece.episodes
    if options.k == 0:  # k=0 draws no goals, and achieved goals may be missing
        return episodes.lengths[:0], episodes.lengths[:0], [0] * len(piece.runs)
    drawn = _Transitions.of(episodes, options.per)
    after = entry_of(rows, chunk.keys.next_achieved)
    keep = None
    if options.filter_achieved:
        rule = partial(missed, reward_fn)
        before = chunk.before()
        starts = None if ends_at_goals(reward_fn, chunk.after()) else before[episodes.rows[:, 0]]
        keep = drawn.filter(before, rule, starts)
    draws = drawn.draws(generators, piece.position)
    pools: list[Tensor] = []
    parts: list[tuple[Tensor, Tensor]] = []
    relabeled = torch.zeros_like(drawn.row, dtype=torch.bool)
    for source, number in options.sources.items():
        if source in RECENT:
            pool, lines = recent.lines(str(source), piece.runs)
            candidates, counts, tries = drawn.pool(pool, lines, piece.position), [1] * len(piece.runs), TRIES
        else:
            candidates, tries, number = drawn.candidates(after, episodes, source), 0, times * number
            counts = piece.sums(torch.ones_like(episodes.lengths))
        own_weights = None if weights is None else partial(weights, runs=piece.runs, counts=counts)
        index, valid = choose_goals(
            candidates,
            number,
            weights=own_weights,
            keep=keep,
            draws=draws,
            tries=tries,
            redraw=options.redraw,
        )
        if source not in RECENT:
            relabeled |= valid.any(-1)
        parts.append((index + sum(map(len, pools)), valid))
        pools.append(candidates.goals)
    index, valid = parts[0]
    if len(parts) > 1:
        index, valid = (torch.cat(each, -1) for each in zip(*parts, strict=True))
    row, goals = drawn.row.unsqueeze(-1).expand_as(index).flatten(), index.flatten()
    if not bool(valid.all()):
        some = valid.flatten().nonzero().squeeze(-1)
        row, goals = row.index_select(0, some), goals.index_select(0, some)
    goals = (pools[0] if len(pools) == 1 else torch.cat(pools)).index_select(0, goals)
    relabeled_of = torch.bincount(drawn.episode[relabeled], minlength=len(episodes.lengths))
    return row, goals, piece.sums(relabeled_of)


class _Transitions(NamedTuple):
    """Transitions [n] for which goals are drawn.

    Attributes:
        row: [n] int64, their positions in the batch.
        episode: [n] int64, ascending: the episode of each transition.
        time: [n] int64, the step of each transition in its episode.
    """

    row: Tensor
    episode: Tensor
    time: Tensor

    @classmethod
    def of(cls, episodes: Episodes, per: Per) -> _Transitions:
        """Selects all transitions of some episodes, or the first one of each."""
        if per == "episode":
            episode = torch.arange(len(episodes.lengths), device=episodes.rows.device)
            return cls(episodes.rows[:, 0], episode, torch.zeros_like(episode))
        return cls(episodes.rows[episodes.inside], *episodes.inside.nonzero(as_tuple=True))

    def candidates(self, after: Tensor, episodes: Episodes, strategy: Strategy) -> Candidates:
        """Returns as candidates the goals that were achieved in the transition's own episode."""
        first, end = candidate_range(strategy, self.time, episodes.lengths[self.episode])
        return Candidates(after, episodes.rows, self.episode, first, end)

    def pool(self, goals: Tensor, lines: Episodes, position: Tensor | None) -> Candidates:
        """Returns as candidates the goals that the transition's run remembers.

        Args:
            goals: [p, g], the goals that all runs remember.
            lines: positions of each run's goals in ``goals``.
            position: [E] int64, the position of each episode's run; None if there is only one.
        """
        line = torch.zeros_like(self.episode) if position is None else position[self.episode]
        return Candidates(goals, lines.rows, line, torch.zeros_like(line), lines.lengths[line])

    def filter(
        self, before: Outcome, keep: Keep | None, starts: Outcome | None = None
    ) -> Callable[[Index, Tensor], Tensor] | None:
        """Returns the filter in the form that :func:`choose_goals` takes.

        If episodes continue at their goals, the filter also keeps goals that were not achieved at the
        episodes' ``starts`` [E, g].
        """
        if keep is None:
            return None
        achieved = before[self.row]
        if starts is None:
            return lambda which, goals: keep(achieved[which].unsqueeze(1), goals)
        start = starts[self.episode]
        return lambda which, goals: (
            keep(achieved[which].unsqueeze(1), goals) | keep(start[which].unsqueeze(1), goals)
        )

    def draws(self, generators: Generators, position: Tensor | None) -> RunDraws:
        """Returns random numbers for transitions, from the generator of each transition's run."""
        return RunDraws(
            generators, None if position is None or len(generators) == 1 else position[self.episode]
        )
