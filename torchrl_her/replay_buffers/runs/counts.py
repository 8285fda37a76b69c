"""Counts of the transitions that a writer has written for each run, and of those that achieved their goal."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from torch import Tensor

from torchrl_her.goals.rewards import missed
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


class RunCounts:
    """Counts of R runs.

    Args:
        runs: R.

    Attributes:
        counts: R counts, each since its run was last emptied.
        totals: R counts of all transitions ever written.

    Example:
        >>> run_counts = RunCounts(2)
        >>> run_counts.add([1], [WriterCounts(real=3)])
        >>> run_counts.empty(1)
        >>> run_counts.add([0, 1], [WriterCounts(real=1), WriterCounts(real=2)])
        >>> [counts.real for counts in run_counts.counts], [totals.real for totals in run_counts.totals]
        ([1, 2], [1, 5])
    """

    def __init__(self, runs: int) -> None:
        self.counts, self.totals = ([WriterCounts() for _ in range(runs)] for _ in range(2))

    def add(self, runs: Sequence[int], added: Sequence[WriterCounts]) -> None:
        """Adds to the counts of m runs, given by their numbers."""
        for run, more in zip(runs, added, strict=True):
            for counts in (self.counts, self.totals):
                counts[run] = WriterCounts.sum((counts[run], more))

    def empty(self, run: int) -> None:
        """Counts a run from 0 again; its totals are kept."""
        self.counts[run] = WriterCounts()

    def state_dict(self) -> dict[str, Any]:
        """Plain data that :meth:`load_state_dict` takes."""
        return {
            "counts": [asdict(counts) for counts in self.counts],
            "totals": [asdict(counts) for counts in self.totals],
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restores the state that :meth:`state_dict` returned."""
        self.counts = [WriterCounts(**counts) for counts in state_dict["counts"]]
        self.totals = [WriterCounts(**counts) for counts in state_dict["totals"]]


def count_rows(
    chunk: Chunk, real: WrittenRows, virtual: WrittenRows | None, relabeled: Sequence[int]
) -> list[WriterCounts]:
    """Counts the transitions of each of a chunk's m runs.

    With the filter, all positive virtual transitions are useful: none of their goals was achieved before.

    Args:
        chunk: Episodes of m runs.
        real, virtual: the transitions that are written for it; None without virtual ones.
        relabeled: m numbers of real transitions that got goals of their own episode.
    """
    least = chunk.options.achieved_reward
    columns = {
        "real": real.counts,
        "relabeled": relabeled,
        "real_positive": _set(real.reward >= least, real.counts),
    }
    if virtual is not None:
        positive = useful = virtual.reward >= least
        if not chunk.options.filter_achieved:
            before = chunk.before()[virtual.root]
            useful = positive & missed(chunk.reward_fn, before, virtual.changes[chunk.keys.goals[0]], least)
        columns["virtual"], columns["virtual_positive"] = virtual.counts, _set(positive, virtual.counts)
        columns["useful_virtual_positive"] = _set(useful, virtual.counts)
    return [
        WriterCounts(**dict(zip(columns, numbers, strict=True)))
        for numbers in zip(*columns.values(), strict=True)
    ]


def _set(flags: Tensor, counts: Sequence[int]) -> list[int]:
    """Returns the number of flags that are set for each run."""
    return [int(part.count_nonzero()) for part in flags.split(list(counts))]
