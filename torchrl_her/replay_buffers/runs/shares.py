"""What several runs have of the transitions that are written at once: the real ones, or the virtual ones."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

from tensordict import TensorDictBase
from torch import Tensor

from torchrl_her.goals.rewards import RewardFunction
from torchrl_her.replay_buffers.copies import (
    Copies,
    episode_numbers,
    real_copies,
    virtual_copies,
    virtual_episodes,
    with_ends,
)
from torchrl_her.replay_buffers.keys import TransitionKeys
from torchrl_her.replay_buffers.options import HindsightOptions
from torchrl_her.replay_buffers.runs.pieces import Piece


class Share(NamedTuple):
    """The real or the virtual transitions of some runs.

    Attributes:
        copies: [n], one run after the other.
        counts: m numbers of transitions, of each run; they sum to n.
    """

    copies: Copies
    counts: list[int]


def real_share(
    rows: TensorDictBase, piece: Piece, options: HindsightOptions, keys: TransitionKeys, *, first_id: int
) -> Share:
    """The real transitions of a piece.

    Args:
        rows: [n], collected transitions.
        piece: some episodes of them.
        options: how they are written.
        keys: where entries are.

    Keyword Args:
        first_id: the trajectory id of the first episode, if whole ones are written; that of the next one is
            higher by 1.
    """
    episodes = piece.episodes
    real = real_copies(rows, episodes, keys, n_steps=options.n_steps, gamma=options.gamma)
    if options.per == "episode":
        real = with_ends(real, rows, episodes, keys)
        real = _with_ids(real, episode_numbers(episodes) + first_id, keys)
    return Share(real.like(rows), piece.sums(episodes.lengths))


def virtual_share(
    rows: TensorDictBase,
    run: Tensor | None,
    piece: Piece,
    source: Tensor,
    goals: Tensor,
    reward_fn: RewardFunction,
    options: HindsightOptions,
    keys: TransitionKeys,
    *,
    first_id: int,
) -> Share:
    """The virtual transitions of a piece, whose goals were drawn.

    Args:
        rows, piece, options, keys: as for :func:`real_share`.
        run: [n] int64, the run of each row; None if there is only one.
        source: [V] int64, the transitions that are copied, or the first ones of whole episodes that are.
        goals: [V, g], those that they get.
        reward_fn: maps (achieved, desired) goals to (reward, terminated).

    Keyword Args:
        first_id: the trajectory id of the first copy of an episode.
    """
    of, achieved_reward = (rows, piece.episodes, source, goals, reward_fn, keys), options.achieved_reward
    if options.per == "episode":
        virtual, number = virtual_episodes(*of, achieved_reward=achieved_reward)
        virtual = _with_ids(virtual, number + first_id, keys)
    else:
        virtual = virtual_copies(
            *of, achieved_reward=achieved_reward, n_steps=options.n_steps, gamma=options.gamma
        )
    return Share(virtual.like(rows), piece.counts(virtual.root, run))


def _with_ids(copies: Copies, ids: Tensor, keys: TransitionKeys) -> Copies:
    """The same with these trajectory ids."""
    return replace(copies, changes={**copies.changes, keys.trajectory: ids})
