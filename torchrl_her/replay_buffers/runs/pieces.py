"""Splits episodes of one or several runs into pieces, each of which is relabeled and written at once."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_her.goals.rewards import Outcome, RewardFunction
from torchrl_her.replay_buffers.episodes import Episodes
from torchrl_her.replay_buffers.keys import TransitionKeys, failures
from torchrl_her.replay_buffers.options import HindsightOptions


class Piece(NamedTuple):
    """Episodes that are written at once.

    Attributes:
        runs: indices of the m runs that have episodes in this piece.
        episodes: episodes, run after run.
        position: [E] int64, ascending: the position in ``runs`` of each episode's run; None for a single run.
    """

    runs: list[int]
    episodes: Episodes
    position: Tensor | None = None

    def sums(self, number: Tensor) -> list[int]:
        """Sums numbers [E], one of each episode, for each of the m runs."""
        if self.position is None:
            return [int(number.sum())]
        return number.new_zeros(len(self.runs)).index_add_(0, self.position, number).tolist()

    def counts(self, index: Tensor, run: Tensor | None) -> list[int]:
        """Counts how many of the given transitions belong to each of the m runs.

        Args:
            index: [V] int64, positions of transitions of these episodes in a batch.
            run: [n] int64, the run of each transition of the batch; None if there is only one.
        """
        if run is None:
            return [len(index)]
        numbers = run.index_select(0, index).bincount(minlength=max(self.runs) + 1).tolist()
        return [numbers[run_index] for run_index in self.runs]


@dataclass(frozen=True)
class Chunk:
    """Episodes of a piece, with the transitions, reward function and options to relabel them.

    Attributes:
        rows: [n], collected transitions, with other episodes among them.
        run: [n] int64, the run of each row; None if there is only one.
        piece: Positions of the episodes in ``rows``, by run.
        reward_fn: Maps (achieved, desired) goals to (reward, terminated).
        options: Number, sources and filter of virtual goals.
        keys: Names of the entries.
    """

    rows: TensorDictBase
    run: Tensor | None
    piece: Piece
    reward_fn: RewardFunction
    options: HindsightOptions
    keys: TransitionKeys

    @property
    def episodes(self) -> Episodes:
        """Positions of the episodes in ``rows``."""
        return self.piece.episodes

    def before(self) -> Outcome:
        """Returns the goals [n, g] that were achieved before the actions."""
        return self.keys.before(self.rows, self.reward_fn)

    def after(self) -> Outcome:
        """Returns the goals [n, g] that the actions achieved."""
        return self.keys.after(self.rows, self.reward_fn)

    def failures(self) -> tuple[Tensor, Tensor]:
        """Returns ``(failed, cost)``, [n, 1] each; see :func:`~torchrl_her.replay_buffers.keys.failures`."""
        return failures(self.rows, self.keys, self.reward_fn)


def split_runs(
    episodes: Episodes, run: Tensor | None, settings: Sequence[Hashable], *, each: int, together: int
) -> Iterator[Piece]:
    """Splits episodes into pieces whose tables (episodes times longest length) have a limited size.

    How the episodes of a run are split does not depend on the other runs.

    Args:
        episodes: episodes, run after run.
        run: [E] int64, ascending: the run of each episode, of R; None if there is only one.
        settings: one object for each of R runs; only runs with equal objects share a piece.

    Keyword Args:
        each: most entries in the table of a single run's episodes. One episode may have more.
        together: most entries in the table of several runs' episodes.
    """
    if len(episodes.lengths) == 0:
        return
    waiting: dict[Hashable, list[_Share]] = {}
    for share in _shares(episodes, run, len(settings), each):
        group = waiting.setdefault(settings[share.run], [])
        horizon = max([share.horizon, *(other.horizon for other in group)])
        number = share.number + sum(other.number for other in group)
        if group and (group[-1].run == share.run or number * horizon > together):
            yield _join(episodes, group)
            group.clear()
        group.append(share)
    yield from (_join(episodes, group) for group in waiting.values())


class _Share(NamedTuple):
    """Consecutive episodes of one run."""

    run: int
    begin: int
    number: int
    horizon: int  # length of the run's longest episode


def _shares(episodes: Episodes, run: Tensor | None, runs: int, each: int) -> Iterator[_Share]:
    numbers, longest = [len(episodes.lengths)], [episodes.rows.shape[1]]
    if run is not None:
        numbers = run.bincount(minlength=runs).tolist()
        longest = episodes.lengths.new_zeros(runs).scatter_reduce_(0, run, episodes.lengths, "amax").tolist()
    begin = 0
    for run_index, (number, horizon) in enumerate(zip(numbers, longest, strict=True)):
        at_once = max(1, each // max(1, horizon))
        for start in range(0, number, at_once):
            yield _Share(run_index, begin + start, min(at_once, number - start), horizon)
        begin += number


def _join(episodes: Episodes, shares: list[_Share]) -> Piece:
    """Joins episodes of different runs to a piece."""
    horizon = max(share.horizon for share in shares)
    first, last = shares[0], shares[-1]
    if last.begin + last.number - first.begin == sum(share.number for share in shares):  # without gaps
        span = slice(first.begin, last.begin + last.number)
        rows, lengths = episodes.rows[span], episodes.lengths[span]
    else:
        parts = [slice(share.begin, share.begin + share.number) for share in shares]
        rows = torch.cat([episodes.rows[part] for part in parts])
        lengths = torch.cat([episodes.lengths[part] for part in parts])
    position = None
    if len(shares) > 1:
        numbers = torch.tensor([share.number for share in shares], device=lengths.device)
        position = torch.arange(len(shares), device=lengths.device).repeat_interleave(numbers)
    return Piece([share.run for share in shares], Episodes(rows[:, :horizon], lengths), position)
