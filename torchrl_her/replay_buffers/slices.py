"""The slices of a batch that was sampled as sequences."""

from __future__ import annotations

import torch
from torch import Tensor


def slice_positions(
    place: Tensor, episode: Tensor, ends: Tensor | None = None, inside: Tensor | None = None
) -> Tensor:
    """Groups the transitions of a batch by slice.

    Args:
        place: [B] int64, places in :class:`~torchrl_her.replay_buffers.EpisodeIndex`; the places of a slice
            follow each other.
        episode: [B] int64, a number that differs between episodes.
        ends: [B, 1] of bool, the last transitions of slices. Without them, slices that happen to follow each
            other are one.
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
    steps = torch.arange(int(length.max()), device=place.device)
    return first.unsqueeze(-1) + steps.minimum(length.unsqueeze(-1) - 1)
