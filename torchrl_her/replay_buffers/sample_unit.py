"""Relabeling while sampling: only real transitions are stored; some of those drawn get other goals.

It draws goals by the same factors as the writer (:class:`~torchrl_her.HERWriter`). Prefer it if the buffer
must stay small (a fifth of the transitions), if goals should be drawn anew each time, or if the storage
holds [T, N] transitions; prefer the writer if sampling must be as fast as possible.

Why this is a ``SampleUnit``, and none of TorchRL's other hooks: a sampler that wraps another one is not a
``PrioritizedSampler`` any more, and ``update_tensordict_priority`` then silently does nothing. A transform
cannot know which transitions it gets, as their index is added after all transforms. A subclass that relabels
what ``_sample`` returns comes too late for transforms that use the goal. A ``SampleUnit`` gets the index and
the storage between drawing and reading, under the buffer's lock, and changes neither. The goals that it chose
are put in by the collate function, which runs before all transforms. So sampler, index and priorities
belong to the real transitions, and the storage (``buffer.storage[:]``) has no others.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache, partial
from threading import get_ident
from typing import Any, ClassVar, NamedTuple
from uuid import uuid4

import torch
from tensordict import TensorDictBase, is_tensor_collection, unravel_key
from torch import Tensor
from torchrl.data import ReplayBuffer, SampleUnit, Storage
from torchrl.data.replay_buffers.samplers import SliceSampler
from torchrl.data.replay_buffers.storages import StorageEnsemble

from torchrl_her.checks import entry_of
from torchrl_her.goals.choose import LIKELIHOODS, TRIES, Candidates, Index, choose_goals
from torchrl_her.goals.factors import combine, draw, draw_uniformly
from torchrl_her.goals.rewards import RewardFunction, ask_reward, ends_at_goals, missed
from torchrl_her.goals.strategies import RECENT, Strategy, candidate_range
from torchrl_her.goals.weights import GoalWeights, checked_weights
from torchrl_her.randomness import RunDraws
from torchrl_her.replay_buffers.episode_index import EpisodeIndex, index_episodes
from torchrl_her.replay_buffers.episodes import slice_positions
from torchrl_her.replay_buffers.keys import device_of, failures, stored_as
from torchrl_her.replay_buffers.n_steps import STEPS_KEY, NStepReturn, n_step_return, windows
from torchrl_her.replay_buffers.neighbors import (
    MASK,
    refuse_consuming,
    refuse_n_steps,
    refuse_padded,
    refuse_shared,
    refuse_slices,
    refuse_stages,
    refuse_unordered,
)
from torchrl_her.replay_buffers.options import HindsightBase, HindsightOptions
from torchrl_her.torchrl_private import (
    buffers_of,
    functions_on_batches,
    generator_of,
    is_full,
    next_row,
    revision_of,
    unit_of,
)


class _Stored(NamedTuple):
    """Entries that were read from a storage, with the state of the storage at that time."""

    storage: Storage
    state: tuple[int, int]
    rows: TensorDictBase  # [n], a view
    after: Tensor  # [n, g], goals that the action achieved: the candidates
    wanted: Tensor  # [n, g], desired goals; converted to the dtype of ``after`` if they serve as candidates
    episodes: EpisodeIndex
    ends: Callable[[], bool]  # whether episodes end at their goals; the reward function is called once
    recent: dict[tuple[str, int], Tensor]  # rows of the newest episodes, cached


class _Chosen(NamedTuple):
    """The virtual goals that were chosen for a batch, and what else is needed to relabel it."""

    shape: torch.Size  # shape of the batch
    rows: Tensor  # [V], positions in the flat batch
    goals: Tensor  # [V, g]
    ends: Tensor | None  # [B, 1] of bool, where a sampler of slices ends a slice
    ahead: tuple[TensorDictBase, NStepReturn] | None  # with n steps: ``next`` of the last step, and returns


class HERSampleUnit(HindsightBase, SampleUnit):
    """When transitions are sampled, gives some of them goals that were achieved later.

    A plain writer stores real transitions, flat or [T, N] (``ndim=2``), and any sampler draws them. Each one
    drawn becomes virtual with probability k / (k + 1), which is the share that a writer with the same k
    stores. A virtual transition has another desired goal in the root and under ``next``; its reward,
    terminated and done are computed again for that goal, and everything else stays as it was, its index and
    priority weight too. A transition whose candidates are all filtered out or have weight 0 stays real. Pass
    the buffer both the unit and its :meth:`relabel`, as in the example.

    Candidates are the transitions of the same episode that are still stored. If an episode's beginning was
    overwritten, they are the remaining ones. In an open episode they reach up to its newest transition, from
    which ``"final"`` then takes the goal. Flat transitions of several environments are distinguished by
    trajectory ids. Under samplers of slices, all transitions of a slice get the same goal: one that its last
    transition may take and, with the filter, that was not achieved before. A priority belongs to the real
    transition, whatever goal it had when the priority was computed.

    With several ``goal_sources``, each gives its part of the virtual transitions. Goals of recent episodes
    are read from the newest stored transitions, open episodes included.

    After each write, sampling the next batch searches the whole storage for the ends of episodes.

    Read stored transitions from the storage (``buffer.storage[:]``): the buffer itself raises an error if it
    is read without sampling. A ``ReplayBufferEnsemble`` raises one, too, since it leaves out the unit.

    Args:
        reward_fn: maps (achieved, desired) goals to (reward, terminated), for instance
            :class:`~torchrl_her.GoalReward`.
        options: how transitions are relabeled; None for the defaults.

    Keyword Args:
        weights: weights of goals, updated with the virtual goals that were chosen; None for equal weights.
            Call their ``clear`` when you empty the buffer. The buffer's state does not contain them: save
            their own ``state_dict``, too.
        generator: source of the random numbers; None for the buffer's (``buffer.set_rng``).
        metadata: whether batches have entries on the origin of goals, named as in TorchRL's units.
            ``"step_offset"`` is the number of steps from a transition's first state to that in which its goal
            was achieved: 1 for what its own action achieved, and below 1 for goals of the past.
            ``"validity_mask"`` marks where the offset counts: at virtual transitions whose goal is of their
            own episode, except for the padding of a slice. Elsewhere the offset is 0. ``"anchor_index"`` is
            the index in the storage.
        **changes: options by name, as in the example; all are listed in
            :class:`~torchrl_her.HindsightOptions`.

    Raises:
        ValueError: an option is out of its range; when sampling, weights are negative or not finite, or the
            unit cannot work beside another part of the buffer.
        TypeError: an option is unknown; when sampling, the storage holds no tensordicts.
        KeyError: when sampling, the storage lacks an entry.
        RuntimeError: the buffer is shared between processes; :meth:`relabel` was not handed to the buffer, or
            is given a batch for which no goals were chosen.

    Example:
        >>> from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
        >>> from torchrl_her import GoalReward
        >>> from torchrl_her_envs import make_env
        >>> hindsight = HERSampleUnit(GoalReward(0.1), k=4)
        >>> buffer = TensorDictReplayBuffer(
        ...     storage=LazyTensorStorage(1000),
        ...     sample_unit=hindsight,
        ...     collate_fn=hindsight.relabel,
        ...     batch_size=1000,
        ... )
        >>> _ = buffer.extend(make_env("hand_v0", num_envs=4, seed=0).rollout(10).reshape(-1))
        >>> batch = buffer.sample()
        >>> round(batch["virtual"].float().mean().item(), 1)  # four of five
        0.8
        >>> bool((batch["next", "reward"][batch["next", "terminated"]] == 0.0).all())
        True
    """

    def __init__(
        self,
        reward_fn: RewardFunction,
        options: HindsightOptions | None = None,
        *,
        weights: GoalWeights | None = None,
        generator: torch.Generator | None = None,
        metadata: bool = False,
        **changes: Any,
    ) -> None:
        super().__init__(reward_fn, options, weights=weights, **changes)
        self.generator, self.metadata = generator, metadata
        self._stored: _Stored | None = None
        self._token = uuid4().hex

    # Goals for ``relabel``, by unit and thread, since a buffer that prefetches draws several batches at once.
    # A class attribute, since Ray copies unit and ``relabel`` separately; both copies find the goals here.
    _chosen: ClassVar[dict[tuple[str, int], _Chosen]] = {}

    # TorchRL's hooks

    def expand(
        self, index: Tensor | tuple[Tensor, ...], info: dict[str, Any], storage: Storage
    ) -> tuple[Tensor | tuple[Tensor, ...], dict[str, Any]]:
        """Chooses virtual goals for a batch, which :meth:`relabel` then writes into it.

        Returns:
            ``(index, info)``, unchanged, with metadata if there are any. Under a sampler of slices, ``info``
            lacks the flags that TorchRL would write over the batch, which would hide where it terminates.
        """
        pending = self._chosen.pop(self._key(), None) is not None
        stored = self._read(storage)
        if pending or not self._may_relabel(storage):
            raise RuntimeError(
                "HERSampleUnit chooses goals that nothing puts into batches; make the buffer with "
                "collate_fn=unit.relabel, too"
            )
        row = _flat(index, storage.shape).to(stored.after.device)
        shape, row = row.shape, row.flatten()
        sampler, ends = self._slice_sampler(storage), None
        groups = torch.arange(len(row), device=row.device).unsqueeze(-1)
        inside = _moved(info.get(MASK), row.device)  # type: ignore[call-overload]  # TorchRL's keys may be nested
        if len(shape) == 2:  # a row for each slice: output_layout="batch_time"
            groups = groups.view(shape)
        elif sampler is not None:
            ends = self._ends(sampler, info, row.device)
            place = stored.episodes.place(row)
            groups = slice_positions(place, stored.episodes.episode(place)[0], ends, inside)
        generator = self.generator if self.generator is not None else generator_of(storage)
        rows, goals, lenders = self._choose(stored, row, groups, generator)
        if self.weights is not None:
            self.weights.update(goals)
        ahead = None if self.options.n_steps == 1 else self._look_ahead(stored, row, rows, goals)
        self._chosen[self._key()] = _Chosen(shape, rows, goals, ends, ahead)
        if ends is not None:
            hidden = {self._keys.terminated, self._keys.done}
            info = {key: value for key, value in info.items() if key not in hidden}
        if lenders is not None:
            valid, episodes = lenders >= 0, stored.episodes
            offset = torch.where(valid, episodes.place(lenders) - episodes.place(row) + 1, 0)
            if inside is not None:
                valid &= inside.flatten()
            info = {
                **info,
                "step_offset": offset.view(shape),
                "anchor_index": torch.stack(index, -1) if isinstance(index, tuple) else index,
                "validity_mask": valid.view(shape),
            }
        return index, info

    def relabel(self, data: TensorDictBase) -> TensorDictBase:
        """Writes the chosen goals into a batch that was just sampled, with their rewards and ends.

        Args:
            data: [B], as read from the storage; [S, T] under a sampler of slices with
                ``output_layout="batch_time"``.

        Returns:
            The same shape, with the goals chosen by :meth:`expand`, and the mark of virtual transitions.

        Raises:
            RuntimeError: no goals were chosen for this batch.
        """
        chosen = self._chosen.pop(self._key(), None)
        if chosen is None:
            raise RuntimeError(
                "no goals were chosen for this batch: HERSampleUnit works in sample() of a single buffer. "
                "Read what is stored from buffer.storage[...]; in a ReplayBufferEnsemble, relabel while "
                "writing, with HERWriter"
            )
        if data.batch_size != chosen.shape:
            raise RuntimeError(
                f"a batch {list(chosen.shape)} was drawn, but a batch {list(data.shape)} was read"
            )
        return self._relabeled(data.reshape(-1), chosen).reshape(chosen.shape)

    def _relabeled(self, data: TensorDictBase, chosen: _Chosen) -> TensorDictBase:
        """Returns a batch [B] with the chosen goals, rewards and ends."""
        out, rows = data.exclude(*self._exclude), chosen.rows
        if self.options.virtual_key is not None:
            marks = torch.zeros(len(data), 1, dtype=torch.bool, device=device_of(rows))
            out.set(self.options.virtual_key, marks.index_fill_(0, rows, True))
        if chosen.ahead is not None:
            after, returns = chosen.ahead
            out = out.set("next", after).exclude(*self._exclude)
            out.set(self._keys.reward, returns.reward).set(STEPS_KEY, returns.steps)
        if chosen.ends is not None:
            done = entry_of(out, self._keys.done)
            out.set(self._keys.truncated, chosen.ends)
            out.set(self._keys.done, done | chosen.ends.view_as(done))
        if len(rows) == 0:
            return out
        if chosen.ahead is not None:
            reward, terminated = returns.reward[rows], returns.terminated[rows]
        else:
            achieved = self._keys.after(data, self.reward_fn)[rows]
            reward, terminated = ask_reward(self.reward_fn, achieved, chosen.goals)
            failed, cost = failures(data, self._keys, self.reward_fn)
            reward, terminated = reward + cost[rows], terminated | failed[rows]
        truncated = entry_of(out, self._keys.truncated)[rows]
        for key, value in self._keys.changes(chosen.goals, reward, terminated, truncated).items():
            entry = entry_of(out, key)
            value = stored_as(value, entry, key)
            out.set(key, entry.index_copy(0, rows, value))  # a copy, since the entry may be the storage's
        return out

    def __getstate__(self) -> dict[str, Any]:
        # Leaves out the generator, as TorchRL does: it cannot be copied to another process. The copy reads
        # the storage again.
        return {**self.__dict__, "generator": None, "_stored": None}

    # Helpers

    def _key(self) -> tuple[str, int]:
        return self._token, get_ident()

    def _buffers(self, storage: Storage) -> Iterator[ReplayBuffer]:
        """Returns the buffers that sample with this unit."""
        for buffer in buffers_of(storage):
            if isinstance(buffer, ReplayBuffer) and unit_of(buffer) is self:
                yield buffer

    def _may_relabel(self, storage: Storage) -> bool:
        """Returns whether the buffer has a user's function that may call :meth:`relabel`."""
        for buffer in self._buffers(storage):
            functions = functions_on_batches(buffer)
            if all(each is None or each.__module__.startswith("torchrl.") for each in functions):
                return False
        return True

    def _slice_sampler(self, storage: Storage) -> SliceSampler | None:
        """Returns the sampler of this unit's buffer if it samples sequences, else None."""
        for buffer in self._buffers(storage):
            if isinstance(buffer.sampler, SliceSampler):
                if self.options.n_steps > 1:
                    raise ValueError(
                        "under a sampler of slices, HERSampleUnit needs n_steps=1, got "
                        f"{self.options.n_steps}: the steps of a slice follow each other already"
                    )
                return buffer.sampler
        if self.options.per == "episode":
            raise ValueError("HERSampleUnit(per='episode') needs a sampler of slices, such as SliceSampler")
        return None

    def _choose(
        self, stored: _Stored, row: Tensor, groups: Tensor, generator: torch.Generator | None
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """Draws which positions [V] in a batch of rows [B] become virtual, and their goals [V, g].

        With metadata, also returns for each row [B] the row of its episode that achieved the goal, or -1.

        ``groups`` [G, L] are positions in the batch that share a goal: a single one, or those of a slice.
        """
        coin = torch.rand(len(groups), device=row.device, generator=generator)
        becomes = coin < self.k / (self.k + 1)
        sources = self.options.sources
        bounds = torch.tensor(list(sources.values()), device=row.device).cumsum(0)[:-1]
        # The same random number also selects the source.
        groups, number = groups[becomes], torch.bucketize(coin[becomes] * (self.k + 1), bounds, right=True)
        virtual = torch.zeros_like(row, dtype=torch.bool)
        goals = stored.after.new_zeros(len(row), *stored.after.shape[1:])
        lenders = torch.full_like(row, -1) if self.metadata else None
        for place, source in enumerate(sources):
            part = groups[number == place]
            lent, valid = self._draw(stored, row[part], source, generator)
            part, lent = part[valid], lent[valid]
            virtual.index_fill_(0, part.flatten(), True)
            drawn = (stored.wanted if source == "actual" else stored.after)[lent]
            goals.index_put_((part,), drawn.unsqueeze(1).expand(-1, part.shape[1], -1))
            if lenders is not None and source not in RECENT:
                lenders[part] = lent.unsqueeze(1)
        rows = virtual.nonzero().squeeze(-1)
        return rows, goals[rows], lenders

    def _ends(self, sampler: SliceSampler, info: dict[str, Any], device: torch.device) -> Tensor | None:
        """Returns the ends of slices as their sampler marks them, [B, 1]; None if it does not."""
        key = sampler.truncated_key
        if key is not None and unravel_key(key) != self._keys.truncated:
            raise ValueError(
                f"the sampler marks ends of slices under {key!r}, and relabeling reads "
                f"{self._keys.truncated!r}: make them the same (truncated_key)"
            )
        return _moved(info.get(key), device)

    def _look_ahead(
        self, stored: _Stored, row: Tensor, virtual: Tensor, goals: Tensor
    ) -> tuple[TensorDictBase, NStepReturn]:
        """Computes n-step returns of rows [B] and ``next`` at their ends; some rows have virtual goals."""
        gamma = self.options.gamma or 1.0  # never None if n_steps > 1
        place = stored.episodes.place(row)
        places, inside = windows(place, stored.episodes.episode(place)[1], self.options.n_steps)
        window = stored.episodes.row(places)
        reward = entry_of(stored.rows, self._keys.reward).reshape(-1, 1)[window]
        end = entry_of(stored.rows, self._keys.done).reshape(-1, 1)[window]
        if len(virtual) > 0:
            desired = goals.unsqueeze(1).expand(-1, window.shape[1], -1)
            reached = self._keys.after(stored.rows, self.reward_fn)[window[virtual]]
            own_reward, own_end = ask_reward(self.reward_fn, reached, desired)
            failed, cost = failures(stored.rows, self._keys, self.reward_fn)
            own_reward = own_reward + cost[window[virtual]]
            reward[virtual] = stored_as(own_reward, reward[0], self._keys.reward).view_as(own_reward)
            end[virtual] = own_end | failed[window[virtual]]
        returns = n_step_return(reward, end, inside, gamma)
        last = window.gather(-1, returns.last.unsqueeze(-1)).squeeze(-1)
        return stored.rows.get("next")[last], returns

    def _read(self, storage: Storage) -> _Stored:
        """Reads the goals and episodes of a storage; the result is cached until something is written."""
        if isinstance(storage, StorageEnsemble):
            raise ValueError(
                "HERSampleUnit cannot work in a ReplayBufferEnsemble: relabel while writing, with HERWriter"
            )
        state = (revision_of(storage), _oldest(storage))
        stored = self._stored
        if stored is None or stored.storage is not storage or stored.state != state:
            refuse_consuming("HERSampleUnit", storage)
            refuse_unordered("HERSampleUnit", storage)
            refuse_shared("HERSampleUnit", storage)
            if storage.ndim > 1:  # in flat ones, samplers mark the ends of slices in copies
                refuse_slices("HERSampleUnit", storage)
            rows = storage[:]  # a view
            if not is_tensor_collection(rows):
                raise TypeError(
                    f"HERSampleUnit needs a storage of tensordicts, such as LazyTensorStorage, "
                    f"got a {type(storage).__name__} that gives a {type(rows).__name__}"
                )
            refuse_n_steps("HERSampleUnit", rows)
            refuse_padded("HERSampleUnit", rows)
            refuse_stages("HERSampleUnit", rows, self.options)
            dims, shape = storage.ndim, rows.shape[: storage.ndim]
            grid = shape if dims == 1 else torch.Size([shape[0], shape[1:].numel()])
            ids, done = rows.get(self._keys.trajectory, None), entry_of(rows, self._keys.done)
            if done.numel() != grid.numel():
                raise ValueError(
                    f"HERSampleUnit needs single transitions, but each item of this storage (ndim={dims}) "
                    f"holds {done.numel() // grid.numel()}: extend with batch.reshape(-1), or give the "
                    "storage ndim=2"
                )
            rows = rows if dims == 1 else rows.flatten(0, dims - 1)
            self._keys.check(rows, "stored", k=1)
            before, after, wanted, next_wanted = (
                entry_of(rows, key)
                for key in (self._keys.achieved, self._keys.next_achieved, *self._keys.goals)
            )
            episodes = index_episodes(
                done.reshape(grid),
                None if ids is None else ids.reshape(grid),
                oldest=state[1],
                seams=((after, before), (next_wanted, wanted)),
            )
            self._look_at_time(episodes.first.diff())
            self._compare_rewards(rows)
            if "actual" in self.options.sources:
                wanted = stored_as(self._keys.asked_for(rows), after, self._keys.next_achieved)
            ends = cache(partial(ends_at_goals, self.reward_fn, self._keys.after(rows, self.reward_fn)))
            self._stored = stored = _Stored(storage, state, rows, after, wanted, episodes, ends, {})
        return stored

    def _draw(
        self, stored: _Stored, group: Tensor, source: Strategy, generator: torch.Generator | None
    ) -> tuple[Tensor, Tensor]:
        """Draws the row [V] whose goal each group gets, and returns a mask [V] of the groups that get one.

        A group [L] is a single row or a slice. Its rows get the same goal, a candidate of its last row.
        """
        if len(group) == 0:
            return group[:, 0], group[:, 0].bool()
        if source in RECENT:
            return self._draw_recent(stored, group, str(source), generator)
        episodes, row = stored.episodes, group[:, -1]
        place = episodes.place(row)
        begin, behind = episodes.episode(place)
        first, end = (bound + begin for bound in candidate_range(source, place - begin, behind - begin))
        valid = torch.ones_like(row, dtype=torch.bool)
        if self.weights is not None and not self.weights.is_uniform:
            lent, valid = self._draw_by_likelihood(stored, group, first, end, generator)
            if self.options.redraw:
                return lent, valid
        else:
            lent = episodes.row(draw_uniformly(first, end, 1, generator=generator).squeeze(-1))
        if not self.filter_achieved:
            return lent, valid
        # Goals are proposed without the filter; only where it rejects one are all candidates checked.
        kept = self._kept(stored, group, stored.after[lent].unsqueeze(1)).squeeze(1)
        if not self.options.redraw:
            return lent, valid & kept
        again = (~kept).nonzero().squeeze(-1)
        lent[again], valid[again] = self._draw_by_likelihood(
            stored, group[again], first[again], end[again], generator
        )
        return lent, valid

    def _draw_recent(
        self, stored: _Stored, group: Tensor, source: str, generator: torch.Generator | None
    ) -> tuple[Tensor, Tensor]:
        """Draws goals that were desired or achieved in the newest episodes."""
        goals, newest = stored.after, stored.episodes.newest
        if source == "actual":
            goals, newest = stored.wanted, stored.episodes.newest_episodes
        which = source, self.options.remembered[source]
        if which not in stored.recent:
            stored.recent[which] = newest(which[1])
        line, table = torch.zeros_like(group[:, 0]), stored.recent[which].unsqueeze(0)

        def keep(which: Index, goals: Tensor) -> Tensor:
            return self._kept(stored, group[which], goals)

        index, valid = choose_goals(
            Candidates(goals, table, line, line, torch.full_like(line, table.shape[1])),
            1,
            weights=None if self.weights is None or self.weights.is_uniform else self.weights,
            keep=keep if self.filter_achieved else None,
            draws=RunDraws([generator]),
            tries=TRIES,
            redraw=self.options.redraw,
        )
        return index.squeeze(-1), valid.squeeze(-1)

    def _kept(self, stored: _Stored, group: Tensor, goals: Tensor) -> Tensor:
        """Applies the filter: returns a mask [V, c] of the goals [V, c, g] that groups [V, L] may take."""
        rule = partial(missed, self.reward_fn)
        before = self._keys.before(stored.rows, self.reward_fn)
        kept = rule(before[group].unsqueeze(1), goals.unsqueeze(2)).all(-1)
        if stored.ends():
            return kept
        episodes = stored.episodes
        start = before[episodes.row(episodes.episode(episodes.place(group[:, -1]))[0])]
        return kept | rule(start.unsqueeze(1), goals)

    def _draw_by_likelihood(
        self, stored: _Stored, group: Tensor, first: Tensor, end: Tensor, generator: torch.Generator | None
    ) -> tuple[Tensor, Tensor]:
        """Draws a goal for each group from all candidates ``first`` to ``end``, by weights and filter."""
        source, valid = torch.empty_like(first), torch.ones_like(first, dtype=torch.bool)
        if len(group) == 0:
            return source, valid
        widest = int((end - first).max())
        steps = torch.arange(widest, device=first.device)
        at_once = max(1, LIKELIHOODS // (widest * group.shape[1]))
        for part in torch.arange(len(group), device=first.device).split(at_once):
            width = (end - first)[part].unsqueeze(-1)
            candidate = stored.episodes.row(first[part].unsqueeze(-1) + steps.minimum(width - 1))
            goals = stored.after[candidate]
            weight = keep = None
            if self.weights is not None and not self.weights.is_uniform:
                weight = checked_weights(self.weights(goals), goals)
            if self.filter_achieved and self.options.redraw:
                keep = self._kept(stored, group[part], goals)
            drawn, valid[part] = draw(combine(steps < width, weight, keep), 1, generator=generator)
            source[part] = candidate.gather(1, drawn).squeeze(-1)
        return source, valid


def _moved(entry: Tensor | None, device: torch.device) -> Tensor | None:
    return None if entry is None else entry.to(device)


def _oldest(storage: Storage) -> int:
    """Returns the slot of a storage's oldest rows.

    Reads the writer's cursor, since TorchRL does not restore the cursor of the storage. If several buffers
    share a storage, the cursor of the buffer that has written most is used.
    """
    if not is_full(storage):
        return 0
    cursors = [
        (buffer.write_count, row)
        for buffer in buffers_of(storage)
        if isinstance(buffer, ReplayBuffer) and (row := next_row(buffer.writer)) is not None
    ]
    return max(cursors, default=(0, 0))[1]


def _flat(index: Tensor | tuple[Tensor, ...], shape: torch.Size) -> Tensor:
    """Converts indices of a storage to positions [B] among all rows, slot after slot."""
    if not isinstance(index, tuple):
        index = (index,) if len(shape) == 1 else index.unbind(-1)
    row = index[0].long()
    for size, coordinate in zip(shape[1:], index[1:], strict=True):
        row = row * size + coordinate
    return row
