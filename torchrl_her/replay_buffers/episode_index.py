"""Finding the episodes of a ring buffer, and which rows of the storage belong to each of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

import torch
from torch import Tensor


@dataclass(frozen=True)
class EpisodeIndex:
    """Index of the episodes in a ring buffer: converts rows of the storage to places in episodes, and back.

    A row is a stored transition. A stream is all rows of one environment. A segment is a stretch of a stream
    whose rows belong to one episode without a break. Each row has a *position*, its index if rows are sorted
    by stream and then by time, and a *place*, its index if all rows of an episode follow each other.

    Attributes:
        slots: T, the number of filled slots of the ring.
        streams: N, the number of rows in each slot; the row of a stream in a slot is ``slot * N + stream``.
        oldest: slot of the oldest rows.
        begins: [S] int64, positions at which segments begin, ascending.
        places: [S] int64, the places of the rows at ``begins``.
        ordered_begins: [S] int64, ``begins`` in the order of episodes.
        ordered_places: [S] int64, ``places`` in the order of episodes, ascending.
        first: [E + 1] int64, places at which episodes begin, and the number of all rows.
    """

    slots: int
    streams: int
    oldest: int
    begins: Tensor
    places: Tensor
    ordered_begins: Tensor
    ordered_places: Tensor
    first: Tensor

    def place(self, row: Tensor) -> Tensor:
        """Returns the places [...] of rows [...] in the order of episodes."""
        position = row % self.streams * self.slots + (row // self.streams - self.oldest) % self.slots
        run = torch.searchsorted(self.begins, position, right=True) - 1
        return self.places[run] + position - self.begins[run]

    def row(self, place: Tensor) -> Tensor:
        """Returns the rows [...] at places [...]; the inverse of :meth:`place`."""
        run = torch.searchsorted(self.ordered_places, place, right=True) - 1
        position = self.ordered_begins[run] + place - self.ordered_places[run]
        return (position % self.slots + self.oldest) % self.slots * self.streams + position // self.slots

    def episode(self, place: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the first place, and the last place + 1, of the episode that contains each place [...]."""
        episode = torch.searchsorted(self.first, place, right=True) - 1
        return self.first[episode], self.first[episode + 1]

    def newest(self, count: int) -> Tensor:
        """Returns up to ``count`` of the newest rows, oldest first."""
        rows = self.slots * self.streams
        number = torch.arange(max(0, rows - count), rows, device=self.first.device)
        return (number // self.streams + self.oldest) % self.slots * self.streams + number % self.streams

    def newest_episodes(self, count: int) -> Tensor:
        """Returns the first rows of up to ``count`` of the newest episodes, open ones too, oldest first."""
        last = self.row(self.first[1:] - 1)
        time = (last // self.streams - self.oldest) % self.slots
        return self.row(self.first[:-1][time.argsort(stable=True)[-count:]])


def index_episodes(
    done: Tensor,
    trajectory: Tensor | None = None,
    *,
    oldest: int = 0,
    seams: Sequence[tuple[Tensor, Tensor]] = (),
) -> EpisodeIndex:
    """Finds the episodes of a ring buffer.

    An episode ends with a row that is done, before a row of its stream with another trajectory id, or with
    the newest row. In flat storages, rows with the same id belong together even if other rows lie between
    them, since a flattened batch of a collector has some steps of each environment, one environment after
    the other. Without ids, flat rows are one stream.

    Args:
        done: [T, N] of bool, time first, N environments; or flat, [T].
        trajectory: ids of the trajectories, integers of the same shape.
        oldest: slot of the oldest row: 0 until the ring is full, then the slot that is overwritten next.
        seams: pairs of entries [n, g] of rows, after the action and before it. Within an episode, the first
            entry of a row equals the second entry of the next row. Where they differ, the episode ends, since
            rows of another collector with the same id, or of another environment, follow.

    Returns:
        The index. An episode that was partly overwritten consists of the rows that are left.

    Example:
        >>> # Slots 0 and 1 were written last: trajectory 3 began in slot 4, and continues in them
        >>> index = index_episodes(torch.zeros(5).bool(), torch.tensor([3, 3, 1, 1, 3]), oldest=2)
        >>> first, end = index.episode(index.place(torch.tensor([0, 2])))
        >>> [index.row(torch.arange(*bounds)).tolist() for bounds in zip(first, end)]
        [[4, 0, 1], [2, 3]]
    """
    slots, rows = len(done), done.numel()
    new = done.roll(1, 0)  # whether an episode begins: true if the row before was done
    if trajectory is not None:
        new[1:] |= trajectory[1:] != trajectory[:-1]
        new[0] |= trajectory[0] != trajectory[-1]
    for pair in seams:
        after, before = (entry.view(*done.shape, -1) for entry in pair)
        new[1:] |= _differ(after[:-1], before[1:])
        new[0] |= _differ(after[-1], before[0])
    new[oldest] = True
    # Only these flags are put in the order of time: moving the ids would take eight times as long.
    begins = new.roll(-oldest, 0).t().reshape(-1).nonzero().squeeze(-1)
    streams, behind = rows // slots, begins.new_tensor([rows])
    if trajectory is None or done.ndim > 1:  # without ids, rows between ends are one episode
        first = torch.cat((begins, behind))
        return EpisodeIndex(slots, streams, oldest, begins, begins, begins, begins, first)
    lengths = begins.diff(append=behind)
    ordered_ids, order = trajectory[(begins + oldest) % slots].sort(stable=True)
    ordered_begins, ordered_lengths = begins[order], lengths[order]
    ordered_places = ordered_lengths.cumsum(0) - ordered_lengths
    places = torch.empty_like(begins).index_copy_(0, order, ordered_places)
    last = (ordered_begins + ordered_lengths - 1 + oldest) % slots
    whole = done[last]
    opens = torch.ones_like(whole)
    opens[1:] = (ordered_ids[1:] != ordered_ids[:-1]) | whole[:-1]
    for after, before in seams:  # segments are one episode only if these entries agree
        opens[1:] |= _differ(after[last[:-1]], before[(ordered_begins[1:] + oldest) % slots])
    first = torch.cat((ordered_places[opens], behind))
    return EpisodeIndex(slots, streams, oldest, begins, places, ordered_begins, ordered_places, first)


def _differ(one: Tensor, other: Tensor) -> Tensor:
    """Returns a mask [...] of pairs of vectors [..., g] that differ; a loop over coordinates is fastest."""
    pairs = zip(one.unbind(-1), other.unbind(-1), strict=True)
    return reduce(torch.logical_or, [a != b for a, b in pairs])
