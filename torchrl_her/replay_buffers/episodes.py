"""Finds whole episodes among the transitions of many environments."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Episodes:
    """Whole episodes, as positions of transitions (rows) in a batch.

    Attributes:
        rows: [E, T] int64; an episode shorter than T is padded with its last row.
        lengths: [E] int64, the lengths of the episodes.
    """

    rows: Tensor
    lengths: Tensor

    @classmethod
    def consecutive(cls, first: Tensor, lengths: Tensor) -> Episodes:
        """Returns episodes [E] whose rows follow each other, from the positions ``first`` on."""
        horizon = int(lengths.max()) if len(lengths) else 0
        step = torch.arange(horizon, device=first.device).minimum(lengths.unsqueeze(-1) - 1)
        return cls(first.unsqueeze(-1) + step, lengths)

    @property
    def inside(self) -> Tensor:
        """Mask of the entries that are not padding, [E, T] of bool."""
        return torch.arange(self.rows.shape[1], device=self.rows.device) < self.lengths.unsqueeze(-1)


def time_order(streams: Tensor) -> Tensor:
    """Returns positions [n] that sort rows by stream, and keep the order of the rows of each stream.

    Args:
        streams: [n] int64, the environment or trajectory of each row.
    """
    if bool((streams[1:] < streams[:-1]).any()):
        return streams.argsort(stable=True)
    return torch.arange(
        len(streams), device=streams.device
    )  # a batch [N, T] is in order already, and sorting takes long


def find_episodes(streams: Tensor, end: Tensor, order: Tensor | None = None) -> tuple[Episodes, Tensor]:
    """Sorts rows into whole episodes and rows of episodes that are still open.

    Args:
        streams: [n] int64, the environment or trajectory of each row. Rows of one stream are in the
            order of time, one episode after the other.
        end: [n] of bool, the last rows of episodes.
        order: [n], from ``time_order``, if it is known already.

    Returns:
        ``(episodes, left)``: the whole episodes, and the positions [m] of all other rows, in order.

    Example:
        >>> streams = torch.tensor([0, 1, 0, 1, 0])  # two environments, three and two steps
        >>> done = torch.tensor([False, False, True, False, False])
        >>> episodes, left = find_episodes(streams, done)
        >>> episodes.rows.tolist(), left.tolist()
        ([[0, 2]], [1, 3, 4])
    """
    order = time_order(streams) if order is None else order
    stream, end = streams[order], end[order]
    begins = torch.ones_like(end)
    begins[1:] = end[:-1] | (stream[1:] != stream[:-1])
    first = begins.nonzero().squeeze(-1)
    length = torch.diff(first, append=first.new_tensor([len(streams)]))
    whole = end[first + length - 1]
    left = order[~whole.repeat_interleave(length)].sort().values
    episodes = Episodes.consecutive(first[whole], length[whole])
    return Episodes(order[episodes.rows], episodes.lengths), left


def slice_positions(
    place: Tensor, episode: Tensor, ends: Tensor | None = None, inside: Tensor | None = None
) -> Tensor:
    """Groups the transitions of a batch of slices (sequences) by slice.

    Args:
        place: [B] int64, places in :class:`~torchrl_her.replay_buffers.EpisodeIndex`; the places of a slice
            follow each other.
        episode: [B] int64, a number that differs between episodes.
        ends: [B, 1], mask of the last transitions of slices. Without it, slices that follow each other by
            chance count as one.
        inside: [B] of bool, False where a slice was padded with its last transition; None for no padding.

    Returns:
        [S, L] int64, positions in the batch; short slices repeat their last transition.

    Example:
        >>> place = torch.tensor([4, 5, 6, 8, 9])
        >>> slice_positions(place, torch.zeros(5)).tolist()
        [[0, 1, 2], [3, 4, 4]]
    """
    begins = torch.ones_like(place, dtype=torch.bool)
    begins[1:] = (place[1:] != place[:-1] + 1) | (episode[1:] != episode[:-1])
    if ends is not None:
        begins[1:] |= ends.flatten()[:-1]
    if inside is not None:
        begins &= inside.flatten()
    first = begins.nonzero().squeeze(-1)
    length = torch.diff(first, append=first.new_tensor([len(place)]))
    return Episodes.consecutive(first, length).rows
