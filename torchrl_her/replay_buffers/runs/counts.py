"""Counts of the transitions that a writer has written, and of those that achieved their goal."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from torch import Tensor

from torchrl_her.goals.rewards import achieved_reward_of, missed
from torchrl_her.replay_buffers.runs.pieces import Chunk
from torchrl_her.replay_buffers.runs.written import WrittenRows


@dataclass
class WriterCounts:
    """Numbers of transitions that were written; positive ones are those that achieved their goal.

    ``relabeled`` counts the real transitions that got goals of their own episode. ``useful_virtual_positive``
    leaves out virtual transitions whose goal was already achieved in the state before. It counts what the
    filter keeps, or would keep if it were on.
    """

    real: int = 0
    virtual: int = 0
    relabeled: int = 0
    real_positive: int = 0
    virtual_positive: int = 0
    useful_virtual_positive: int = 0

    @classmethod
    def sum(cls, counts: Iterable[WriterCounts]) -> WriterCounts:
        """Returns the sums over several counts."""
        return cls(*map(sum, zip(*(vars(each).values() for each in counts), strict=True)))


def count_rows(
    chunk: Chunk, real: WrittenRows, virtual: WrittenRows | None, relabeled: Sequence[int]
) -> list[WriterCounts]:
    """Counts the transitions of each of a chunk's m runs.

    With the filter, all positive virtual transitions are useful: none of their goals was achieved before.

    Args:
        chunk: Episodes of m runs.
        real, virtual: the transitions that are written for the chunk; None without virtual ones.
        relabeled: for each run, the number of real transitions that got goals of their own episode.
    """
    least = achieved_reward_of(chunk.reward_fn)
    columns = {
        "real": real.counts,
        "relabeled": relabeled,
        "real_positive": _set(real.reward >= least, real.counts),
    }
    if virtual is not None:
        positive = useful = virtual.reward >= least
        if not chunk.options.filter_achieved:
            before = chunk.before()[virtual.root]
            useful = positive & missed(chunk.reward_fn, before, virtual.changes[chunk.keys.goals[0]])
        columns["virtual"], columns["virtual_positive"] = virtual.counts, _set(positive, virtual.counts)
        columns["useful_virtual_positive"] = _set(useful, virtual.counts)
    return [
        WriterCounts(**dict(zip(columns, numbers, strict=True)))
        for numbers in zip(*columns.values(), strict=True)
    ]


def _set(flags: Tensor, counts: Sequence[int]) -> list[int]:
    """Returns the number of flags that are set for each run."""
    return [int(part.count_nonzero()) for part in flags.split(list(counts))]
