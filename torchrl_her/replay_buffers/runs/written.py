"""Builds the real and virtual transitions that a writer stores, as copies of collected ones with changes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, is_leaf_nontensor
from torch import Tensor

from torchrl_her.checks import entry_of
from torchrl_her.goals.rewards import ask_reward
from torchrl_her.replay_buffers.episodes import Episodes
from torchrl_her.replay_buffers.keys import stored_as
from torchrl_her.replay_buffers.n_steps import STEPS_KEY, n_step_return, windows
from torchrl_her.replay_buffers.runs.pieces import Chunk


@dataclass(frozen=True)
class WrittenRows:
    """Real or virtual transitions [m] of some runs: copies of collected ones, except for some entries.

    Attributes:
        root: [m] int64, positions of the collected transitions that the root is copied from, sorted by run.
        last: [m] int64, positions of the collected transitions that ``next`` is copied from; the same tensor
            as ``root`` if transitions span single steps.
        changes: Entries that differ, [m, ...] each.
        reward: [m], the reward of the last step.
        counts: Numbers of transitions of each run, which sum to m.
    """

    root: Tensor
    last: Tensor
    changes: dict[NestedKey, Tensor]
    reward: Tensor
    counts: list[int]

    def entry(self, rows: TensorDictBase, key: NestedKey) -> Tensor:
        """Returns an entry of these transitions, [m, ...]."""
        if key not in self.changes:
            order = self.last if isinstance(key, tuple) and key[0] == "next" else self.root
            return entry_of(rows, key).index_select(0, order)
        return self.changes[key]

    def like(self, rows: TensorDictBase) -> WrittenRows:
        """Returns these transitions, their changes cast to the types and shapes of the collected entries.

        Raises:
            ValueError: an entry cannot hold a value.
        """
        changes = dict(self.changes)
        for key, value in self.changes.items():
            if (entry := rows.get(key, None)) is not None:
                # Discounted sums of integers are not integers, so their dtype stays.
                summed = STEPS_KEY in changes and value.is_floating_point()
                changes[key] = value.view(-1, *entry.shape[1:]) if summed else stored_as(value, entry, key)
        return replace(self, changes=changes)


def real_rows(chunk: Chunk, *, first_id: int) -> WrittenRows:
    """Returns the real transitions of a chunk, with their own desired goals.

    If whole episodes are written, those ended by a reset from outside are truncated, so that samplers of
    slices find their end.

    Args:
        chunk: Episodes of m runs.
        first_id: Trajectory id of the first episode, if whole episodes are written; ids rise by 1
            from episode to episode.
    """
    rows, episodes, keys, options = chunk.rows, chunk.episodes, chunk.keys, chunk.options
    root, counts = episodes.rows[episodes.inside], chunk.piece.sums(episodes.lengths)
    reward = entry_of(rows, keys.reward).reshape(-1, 1)
    if options.n_steps > 1 and options.gamma is not None:
        window, inside = _windows(chunk, root)
        done = entry_of(rows, keys.done).reshape(-1, 1)
        out = n_step_return(reward[window], done[window], inside, options.gamma)
        last = _at(window, out.last)
        changes: dict[NestedKey, Tensor] = {keys.reward: out.reward, STEPS_KEY: out.steps}
    else:
        last, changes = root, {}
        if options.per == "episode":
            done, truncated = (entry_of(rows, key)[root].view(-1, 1) for key in (keys.done, keys.truncated))
            cut = torch.zeros_like(done).index_fill_(0, episodes.lengths.cumsum(0) - 1, True) & ~done
            ids = _episode_numbers(episodes) + first_id
            changes = {keys.truncated: truncated | cut, keys.done: done | cut, keys.trajectory: ids}
    return WrittenRows(root, last, changes, reward.flatten().index_select(0, last), counts).like(rows)


def virtual_rows(chunk: Chunk, source: Tensor, goals: Tensor, *, first_id: int) -> WrittenRows:
    """Returns copies of a chunk's transitions, each for a virtual goal.

    A transition over several steps ends where it terminates: by the reward function, or where the episode
    itself terminated without its goal. The cost of such a failure is added to the reward.
    Copies of whole episodes end where the reward function terminates them, and are truncated at the episode's
    end otherwise.

    Args:
        chunk: Episodes of m runs.
        source: [V] int64, the copied transitions; if whole episodes are copied, their first transitions.
        goals: [V, g], the goal of each copy.
        first_id: Trajectory id of the first copy, if whole episodes are written.
    """
    make = _virtual_episodes if chunk.options.per == "episode" else _virtual_transitions
    root, last, changes, reward = make(chunk, source, goals, first_id)
    counts = chunk.piece.counts(root, chunk.run)
    return WrittenRows(root, last, changes, reward.flatten(), counts).like(chunk.rows)


_Parts = tuple[Tensor, Tensor, dict[NestedKey, Tensor], Tensor]  # fields of WrittenRows


def _virtual_transitions(chunk: Chunk, source: Tensor, goals: Tensor, _first_id: int) -> _Parts:
    rows, keys, options = chunk.rows, chunk.keys, chunk.options
    achieved, (failed, cost) = chunk.after(), chunk.failures()
    truncated = entry_of(rows, keys.truncated)
    if options.n_steps == 1 or options.gamma is None:
        reward, terminated = ask_reward(chunk.reward_fn, achieved[source], goals)
        reward, terminated = reward + cost[source], terminated | failed[source]
        changes = keys.changes(goals, reward, terminated, truncated.index_select(0, source))
        return source, source, changes, reward
    window, inside = _windows(chunk, source)
    desired = goals.unsqueeze(1).expand(-1, window.shape[1], -1)
    reward, terminated = ask_reward(chunk.reward_fn, achieved[window], desired)
    reward = reward + cost[window]
    out = n_step_return(reward, terminated | failed[window], inside, options.gamma)
    last = _at(window, out.last)
    changes = keys.changes(goals, out.reward, out.terminated, truncated.index_select(0, last))
    return source, last, {**changes, STEPS_KEY: out.steps}, _at(reward.squeeze(-1), out.last)


def _virtual_episodes(chunk: Chunk, source: Tensor, goals: Tensor, first_id: int) -> _Parts:
    rows, episodes, keys = chunk.rows, chunk.episodes, chunk.keys
    number = _by_row(chunk, _episode_numbers(episodes))[source]
    table, inside = episodes.rows[number], episodes.inside[number]
    desired = goals.unsqueeze(1).expand(-1, table.shape[1], -1)
    reward, terminated = ask_reward(chunk.reward_fn, chunk.after()[table], desired)
    failed, cost = chunk.failures()
    reward, terminated = reward + cost[table], terminated | failed[table]
    ended = terminated.squeeze(-1).cumsum(-1) - terminated.squeeze(-1).to(torch.int64)
    used = inside & (ended == 0)
    stop = used.clone()
    stop[:, :-1] &= ~used[:, 1:]
    root, reward, terminated = table[used], reward[used].view(-1, 1), terminated[used].view(-1, 1)
    truncated = entry_of(rows, keys.truncated)[root].view(-1, 1) | (stop[used].view(-1, 1) & ~terminated)
    copy = torch.arange(len(source), device=table.device).unsqueeze(-1).expand_as(table)
    changes = keys.changes(desired[used], reward, terminated, truncated)
    changes |= {keys.truncated: truncated, keys.trajectory: copy[used] + first_id}
    return root, root, changes, reward


def _episode_numbers(episodes: Episodes) -> Tensor:
    """Returns the episode of each transition in ``episodes.rows[episodes.inside]``, [n]."""
    number = torch.arange(len(episodes.lengths), device=episodes.rows.device)
    return number.repeat_interleave(episodes.lengths)


def _by_row(chunk: Chunk, numbers: Tensor) -> Tensor:
    """Scatters numbers of the transitions ``rows[inside]`` to their positions, [n]; 0 elsewhere."""
    episodes = chunk.episodes
    return episodes.rows.new_zeros(len(chunk.rows)).index_copy_(0, episodes.rows[episodes.inside], numbers)


def _windows(chunk: Chunk, source: Tensor) -> tuple[Tensor, Tensor]:
    """Returns positions [V, m] of up to n steps from each transition on, and which are in its episode."""
    episodes = chunk.episodes
    real = episodes.rows[episodes.inside]  # rows by episode; a place is a position in this list
    place = _by_row(chunk, torch.arange(len(real), device=real.device))
    end = episodes.lengths.cumsum(0)[_episode_numbers(episodes)]
    places, inside = windows(place[source], end[place[source]], chunk.options.n_steps)
    return real[places], inside


def _at(window: Tensor, index: Tensor) -> Tensor:
    return window.gather(-1, index.unsqueeze(-1)).squeeze(-1)


def join_rows(
    rows: TensorDictBase,
    virtual: WrittenRows | None,
    real: WrittenRows,
    *,
    exclude: Sequence[NestedKey],
    virtual_key: NestedKey | None,
) -> TensorDictBase:
    """Builds transitions for the storage, run after run, in each run first virtual and then real ones.

    Args:
        rows: [n], collected transitions.
        virtual: virtual transitions of some runs; None if there are none.
        real: real transitions of the same runs.

    Keyword Args:
        exclude: entries of ``rows`` that are left out.
        virtual_key: key of a bool [..., 1] that marks virtual transitions; None for no mark.
    """
    both = [real] if virtual is None else [virtual, real]

    def join(parts: list[Tensor]) -> Tensor:
        """Joins a tensor of the virtual and one of the real transitions, run after run."""
        split = [part.split(written.counts) for part, written in zip(parts, both, strict=True)]
        return torch.cat([part for run in zip(*split, strict=True) for part in run])

    changed = list(dict.fromkeys(key for written in both for key in written.changes))
    same = rows.exclude(*exclude, *changed)
    root = join([written.root for written in both])
    if all(written.last is written.root for written in both):  # all transitions are single steps
        out = take_rows(same, root)
    else:
        out = take_rows(same.exclude("next"), root)
        out.set("next", take_rows(same.get("next"), join([written.last for written in both])))
    for key in changed:
        out.set(key, join([written.entry(rows, key) for written in both]))
    if virtual_key is not None:
        marks = [torch.full_like(written.root, written is virtual, dtype=torch.bool) for written in both]
        out.set(virtual_key, join(marks).unsqueeze(-1))
    return out


def take_rows(transitions: TensorDictBase, index: Tensor) -> TensorDictBase:
    """Copies the transitions at some positions [m], with their entries that are not tensors."""
    out = transitions.apply(partial(_take, index=index), batch_size=index.shape, is_leaf=is_leaf_nontensor)
    return TensorDict(batch_size=index.shape, device=index.device) if out is None else out


def _take(entry: Any, index: Tensor) -> Any:
    """Copies rows of an entry, which is flattened if a row is one number: torch then indexes far faster."""
    if not isinstance(entry, Tensor):
        return entry[index]
    if entry.shape[1:].numel() == 1:
        return entry.flatten().index_select(0, index).view(-1, *entry.shape[1:])
    return entry.index_select(0, index)
