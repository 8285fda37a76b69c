"""Streams: the environment or the trajectory that each transition of a batch belongs to.

Batches come from one collector or from several, with or without ids. Transitions of one stream are in the
order of time, one episode after the other, and a stream continues from batch to batch.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_her.replay_buffers.keys import TransitionKeys, device_of

BY_ENV, BY_TRAJECTORY, BY_PLACE = "environment ids", "trajectory ids", "places in the batch"

_REMEDY = (
    "Append the transform torchrl_her.EnvIds() to the environments, so that they can be told apart. "
    "If it was you who reset them (collector.reset()), call HERWriter.end_episodes(), too"
)


def find_streams(data: TensorDictBase, keys: TransitionKeys) -> tuple[str, Tensor]:
    """Returns the streams of a batch [N, T], time last, or of a flat batch [n].

    A stream is the environment or the trajectory that a transition belongs to. Environment ids are used if
    the batch has them. Without them, each row of a batch [N, T] is an environment. A flat batch is split by
    trajectory ids; without these, it counts as one environment.

    Returns:
        ``(kind, streams)``: how streams were found, and the stream of each transition, int64, flat.

    Raises:
        ValueError: environment ids are not one whole number for each transition.

    Example:
        >>> from tensordict import TensorDict
        >>> from torchrl_her import HindsightOptions
        >>> kind, streams = find_streams(TensorDict(batch_size=[2, 3]), HindsightOptions().transition_keys())
        >>> kind, streams.tolist()
        ('places in the batch', [0, 0, 0, 1, 1, 1])
    """
    if (envs := data.get(keys.env_ids, None)) is not None:
        if envs.numel() != data.numel() or envs.is_floating_point():
            raise ValueError(
                f"ids of environments ({keys.env_ids!r}) must be one whole number for each transition, got "
                f"{envs.dtype} of shape {list(envs.shape)}: use another env_ids_key if that entry is "
                "something else"
            )
        return BY_ENV, envs.reshape(-1)
    if data.ndim == 1 and (trajectory := data.get(keys.trajectory, None)) is not None:
        return BY_TRAJECTORY, trajectory.reshape(-1)
    steps = max(data.shape[-1], 1)
    places = torch.arange(data.numel() // steps, device=device_of(data))
    return BY_PLACE, places.repeat_interleave(steps)


def in_order(streams: Tensor) -> Tensor:
    """Numbers streams [n] in the order in which they first appear, so that random ids do not affect results.

    Example:
        >>> in_order(torch.tensor([7, 7, 3, 7, 5])).tolist()
        [0, 0, 1, 0, 2]
    """
    _, number = streams.unique(return_inverse=True)
    place = torch.arange(len(streams), device=streams.device)
    first = place.new_full((int(number.max()) + 1 if len(streams) else 0,), len(streams))
    first = first.scatter_reduce(0, number, place, "amin")
    return first.argsort().argsort()[number]


def broken(
    rows: TensorDictBase,
    streams: Tensor,
    order: Tensor,
    done: Tensor,
    keys: TransitionKeys,
    *,
    kind: str,
    held: int,
    resumed: bool,
) -> Tensor:
    """Returns a mask [n] of transitions that end an episode although they are not done.

    Another episode's transition follows them in the same stream: an environment was reset from outside, or
    another collector uses the same ids again.

    Args:
        rows: [n], the first of which were held back, as their episodes were open.
        streams: [n], the stream of each row.
        order: [n], result of :func:`~torchrl_her.replay_buffers.episodes.time_order`.
        done: [n], mask of the rows that are known to end an episode.
        keys: keys of the goals.
        kind: property that distinguishes streams.
        held: number of rows that were held back.
        resumed: whether these rows come from a checkpoint: their episodes may then end anywhere.

    Raises:
        ValueError: streams are places in the batch, and it cannot be known whether an episode is over, or
            whether this batch comes from other environments than the one before.
    """
    over = torch.zeros_like(streams, dtype=torch.bool)
    trajectory = rows.get(keys.trajectory, None)
    last, new = order[:-1], order[1:]
    same = streams[last] == streams[new]
    if trajectory is None or kind == BY_TRAJECTORY:  # without ids, goals show where episodes end
        # Rows that were held back have been compared with each other before.
        over[last] = _jumps(rows, keys, last, new, same & (new >= held))
    else:
        ids = trajectory.reshape(-1)[order]
        seam = same & (last < held) & (new >= held)
        over[last] = (same & (ids[1:] != ids[:-1])) | _jumps(rows, keys, last, new, seam)
    over &= ~done
    if kind == BY_PLACE and not resumed and bool(over.any()):
        raise ValueError(
            f"{int(over.count_nonzero())} episodes are not over, but other ones follow in their places: "
            "either environments were reset from outside, or batches come from several collectors. " + _REMEDY
        )
    return over


def ends_of_held(streams: Tensor, order: Tensor, held: int) -> Tensor:
    """Returns a mask [n] of the last held-back transition of each stream."""
    rows = order[order < held]
    last = torch.ones_like(rows, dtype=torch.bool)
    last[:-1] = streams[rows[1:]] != streams[rows[:-1]]
    return torch.zeros_like(streams, dtype=torch.bool).index_fill_(0, rows[last], True)


def _jumps(rows: TensorDictBase, keys: TransitionKeys, last: Tensor, new: Tensor, where: Tensor) -> Tensor:
    """Returns which pairs of successive rows, of those ``where`` [n - 1], have goals of two episodes."""
    at = where.nonzero().squeeze(-1)
    jumps = torch.zeros_like(where)
    if len(at) == 0:
        return jumps
    for after, before in ((keys.next_achieved, keys.achieved), (keys.goals[1], keys.goals[0])):
        if (one := rows.get(after, None)) is None or (other := rows.get(before, None)) is None:
            continue  # goals may be missing if no virtual goals are drawn
        jumps[at] |= (one[last[at]] != other[new[at]]).flatten(1).any(1)
    return jumps
