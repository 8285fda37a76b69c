"""Relabeling while sampling: only real transitions are stored, and those that are drawn get other goals.

It draws goals by the same factors as the writer (:class:`~torchrl_her.HERWriter`). Prefer it if the buffer
must stay small (a fifth of the transitions), if goals should be drawn anew each time, or if the storage
holds [T, N] transitions; prefer the writer if sampling must be as fast as possible.

Why this is a ``SampleUnit``, and none of TorchRL's other hooks: a sampler that wraps another one is not a
``PrioritizedSampler`` any more, and ``update_tensordict_priority`` then silently does nothing. A transform is
not told which transitions it was given, as their index is added after all transforms. A subclass that
relabels what ``_sample`` returns comes too late for transforms that use the goal. A ``SampleUnit`` is shown
the index and the storage between drawing and reading, under the buffer's lock. It changes neither of them.
The goals that it chose are put in by the collate function, which runs before all transforms. So sampler,
index and priorities are those of the real transitions, and reading (``buffer[:]``) shows real ones.
"""

from __future__ import annotations

from threading import get_ident
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase, is_tensor_collection
from torch import Tensor
from torchrl.data import SampleUnit, Storage

from torchrl_her.goals.factors import combine, draw, draw_alike
from torchrl_her.goals.rewards import RewardFunction
from torchrl_her.goals.strategies import candidate_range
from torchrl_her.goals.weights import GoalWeights, checked_weights
from torchrl_her.replay_buffers.episode_index import EpisodeIndex, index_episodes
from torchrl_her.replay_buffers.keys import entry_of
from torchrl_her.replay_buffers.options import HindsightBase, HindsightOptions

# Likelihoods of goals [transitions, T] that are held in memory at once.
_LIKELIHOODS = 1 << 17


class _Stored(NamedTuple):
    """What was read from a storage, and in which state it was then."""

    storage: Storage
    state: tuple[int, int]
    before: Tensor  # [n, g], goals achieved before the action
    after: Tensor  # [n, g], those that the action achieved: the candidates
    episodes: EpisodeIndex


class _Chosen(NamedTuple):
    """The changes that a batch needs."""

    size: int
    rows: Tensor  # [V], places in the batch
    goals: Tensor  # [V, g]


class HERSampleUnit(HindsightBase, SampleUnit):
    """Gives transitions goals that were achieved later, as they are sampled.

    A plain writer stores real transitions, flat or [T, N] (``ndim=2``), and any sampler draws them. Each one
    drawn becomes virtual with probability k / (k + 1), which is the share that a writer with the same k
    stores. A virtual transition has another desired goal in the root and under ``next``; its reward,
    terminated and done are computed again for that goal, and everything else stays as it was, its index and
    priority weight too. A transition whose candidates are all filtered out or of weight 0 stays real. Hand
    the buffer both the unit and its :meth:`relabel`, as in the example.

    Candidates are the transitions of the same episode that are still stored. If an episode's beginning was
    overwritten, they are the remaining ones; if an episode is still open, those up to the newest one, which
    is also the goal of ``"final"`` then. Flat transitions of several environments are told apart by
    trajectory ids. Under samplers of slices, each transition of a slice gets a goal of its own. A priority
    belongs to the real transition, whatever goal it had when the priority was computed.

    Args:
        reward_fn: maps (achieved, desired) goals to (reward, terminated), for instance
            :class:`~torchrl_her.GoalReward`.
        options: how transitions are relabeled; None for the defaults.

    Keyword Args:
        weights: prefers some goals to others, and is told which ones were given; None for all alike. It is
            not told when the buffer is emptied, so call its ``clear`` then. It is not part of the buffer's
            state but has a ``state_dict`` of its own.
        generator: source of the random numbers; None for the buffer's (``buffer.set_rng``).
        **changes: options by name, as in the example; all are listed in
            :class:`~torchrl_her.HindsightOptions`.

    Raises:
        ValueError: an option cannot be; when sampling, weights are negative or not finite.
        TypeError: an unknown option; when sampling, the storage holds no tensordicts.
        KeyError: when sampling, the storage lacks an entry.
        RuntimeError: at the second batch, :meth:`relabel` was not handed to the buffer.

    Example:
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
        >>> from torchrl_her import GoalReward
        >>> hindsight = HERSampleUnit(GoalReward(0.5), k=4, strategy="final")
        >>> buffer = TensorDictReplayBuffer(
        ...     storage=LazyTensorStorage(100),
        ...     sample_unit=hindsight,
        ...     collate_fn=hindsight.relabel,
        ...     batch_size=1000,
        ... )
        >>> goals = torch.arange(4.0).unsqueeze(-1)  # a walk along 0, 1, 2, 3; 9 was wanted
        >>> last = torch.tensor([False, False, True]).unsqueeze(-1)
        >>> episode = TensorDict(
        ...     {
        ...         "achieved_goal": goals[:-1],
        ...         "desired_goal": torch.full((3, 1), 9.0),
        ...         "next": {
        ...             "achieved_goal": goals[1:],
        ...             "desired_goal": torch.full((3, 1), 9.0),
        ...             "reward": -torch.ones(3, 1),
        ...             "terminated": torch.zeros(3, 1, dtype=torch.bool),
        ...             "truncated": last,
        ...             "done": last,
        ...         },
        ...     },
        ...     batch_size=[3],
        ... )
        >>> _ = buffer.extend(episode)
        >>> batch = buffer.sample()
        >>> batch["desired_goal"].unique().tolist()
        [3.0, 9.0]
        >>> reached = batch["next", "terminated"]
        >>> batch["achieved_goal"][reached].unique().tolist(), batch["next", "reward"][reached].max()
        ([2.0], tensor(0.))
    """

    def __init__(
        self,
        reward_fn: RewardFunction,
        options: HindsightOptions | None = None,
        *,
        weights: GoalWeights | None = None,
        generator: torch.Generator | None = None,
        **changes: Any,
    ) -> None:
        super().__init__(reward_fn, options, weights=weights, **changes)
        self.generator = generator
        self._stored: _Stored | None = None
        # For each thread: a buffer that prefetches draws and collates several batches at once.
        self._chosen: dict[int, _Chosen] = {}

    # TorchRL's hooks

    def expand(
        self, index: Tensor | tuple[Tensor, ...], info: dict[str, Any], storage: Storage
    ) -> tuple[Tensor | tuple[Tensor, ...], dict[str, Any]]:
        """Chooses the goals that :meth:`relabel` puts in; returns index and info unchanged."""
        if self._chosen.pop(get_ident(), None) is not None:
            raise RuntimeError(
                "the batch before was never relabeled: make the buffer with collate_fn=unit.relabel, too"
            )
        stored = self._read(storage)
        row = _flat(index, storage.shape).to(stored.after.device)
        generator = self.generator if self.generator is not None else storage._rng
        coin = torch.rand(len(row), device=row.device, generator=generator)
        rows = (coin < self.k / (self.k + 1)).nonzero().squeeze(-1)
        source, valid = self._draw(stored, row[rows], generator)
        if valid is not None:
            rows, source = rows[valid], source[valid]
        goals = stored.after[source]
        if self.weights is not None:
            self.weights.update(goals)
        self._chosen[get_ident()] = _Chosen(len(row), rows, goals)
        return index, info

    def relabel(self, data: TensorDictBase) -> TensorDictBase:
        """Puts the chosen goals into a batch that was just sampled, with their rewards and ends.

        Args:
            data: [B], as read from the storage. A batch that was read without sampling is returned unchanged.

        Returns:
            [B], with the goals chosen by :meth:`expand`, and the mark of virtual transitions.
        """
        chosen = self._chosen.pop(get_ident(), None)
        if chosen is None:
            return data
        if data.batch_size != (chosen.size,):
            raise RuntimeError(f"{chosen.size} rows were drawn, but a batch {list(data.shape)} was read")
        out, rows = data.exclude(*self._exclude), chosen.rows
        if self.options.virtual_key is not None:
            marks = torch.zeros(chosen.size, 1, dtype=torch.bool, device=rows.device)
            out.set(self.options.virtual_key, marks.index_fill_(0, rows, True))
        if len(rows) == 0:
            return out
        achieved = entry_of(data, self._keys.next_achieved)[rows]
        reward, terminated = self.reward_fn(achieved, chosen.goals)
        truncated = entry_of(data, self._keys.truncated)[rows]
        for key, value in self._keys.changes(chosen.goals, reward, terminated, truncated).items():
            entry = entry_of(data, key)
            value = value.to(entry.dtype).view(len(rows), *entry.shape[1:])
            out.set(key, entry.index_copy(0, rows, value))  # a copy: what was read might be the storage
        return out

    def __getstate__(self) -> dict[str, Any]:
        # As TorchRL does: a generator cannot be copied to another process. The storage can be read again.
        return {**self.__dict__, "generator": None, "_stored": None, "_chosen": {}}

    # The work

    def _read(self, storage: Storage) -> _Stored:
        """Goals and episodes of a storage; read again only after something was written."""
        state = (storage._mutation_revision, _oldest(storage))
        stored = self._stored
        if stored is None or stored.storage is not storage or stored.state != state:
            rows = storage[:]  # a view
            if not is_tensor_collection(rows):
                raise TypeError(
                    f"HERSampleUnit needs a storage of tensordicts, such as LazyTensorStorage, "
                    f"got a {type(storage).__name__} that gives a {type(rows).__name__}"
                )
            dims, shape = storage.ndim, rows.shape[: storage.ndim]
            grid = shape if dims == 1 else torch.Size([shape[0], shape[1:].numel()])
            ids = rows.get(self._keys.trajectory, None)
            episodes = index_episodes(
                entry_of(rows, self._keys.done).reshape(grid),
                None if ids is None else ids.reshape(grid),
                oldest=state[1],
            )
            before, after = (
                entry_of(rows, key).flatten(0, dims - 1)
                for key in (self._keys.achieved, self._keys.next_achieved)
            )
            self._stored = stored = _Stored(storage, state, before, after, episodes)
        return stored

    def _draw(
        self, stored: _Stored, row: Tensor, generator: torch.Generator | None
    ) -> tuple[Tensor, Tensor | None]:
        """For rows [V], the rows [V] whose goals they take, and which [V] may take one; None for all."""
        episodes = stored.episodes
        place = episodes.place(row)
        begin, behind = episodes.episode(place)
        first, end = (
            bound + begin for bound in candidate_range(self.strategy, place - begin, behind - begin)
        )
        if self.weights is not None and not self.weights.alike:
            return self._draw_by_likelihood(stored, row, first, end, generator)
        source = episodes.row(draw_alike(first, end, 1, generator=generator).squeeze(-1))
        if not self.filter_achieved:
            return source, None
        # Goals are proposed without the filter; only where it rejects one are all candidates looked at.
        again = (~self._keep(stored.before[row], stored.after[source])).nonzero().squeeze(-1)
        valid = torch.ones_like(row, dtype=torch.bool)
        source[again], valid[again] = self._draw_by_likelihood(
            stored, row[again], first[again], end[again], generator
        )
        return source, valid

    def _draw_by_likelihood(
        self, stored: _Stored, row: Tensor, first: Tensor, end: Tensor, generator: torch.Generator | None
    ) -> tuple[Tensor, Tensor]:
        """The same as ``_draw``, computed from all candidates of each row, ``first`` to ``end``."""
        if len(row) == 0:
            return row, torch.ones_like(row, dtype=torch.bool)
        widest = int((end - first).max())
        steps = torch.arange(widest, device=row.device)
        source, valid = torch.empty_like(row), torch.empty_like(row, dtype=torch.bool)
        for part in torch.arange(len(row), device=row.device).split(max(1, _LIKELIHOODS // widest)):
            width = (end - first)[part].unsqueeze(-1)
            candidate = stored.episodes.row(first[part].unsqueeze(-1) + steps.minimum(width - 1))
            goals = stored.after[candidate]
            weight = keep = None
            if self.weights is not None and not self.weights.alike:
                weight = checked_weights(self.weights(goals))
            if self.filter_achieved:
                keep = self._keep(stored.before[row[part]].unsqueeze(1), goals)
            drawn, valid[part] = draw(combine(steps < width, weight, keep), 1, generator=generator)
            source[part] = candidate.gather(1, drawn).squeeze(-1)
        return source, valid


def _oldest(storage: Storage) -> int:
    """The slot of a storage's oldest rows.

    The writer's cursor tells: the storage's own last cursor is not restored with a checkpoint. If several
    buffers share a storage, it is the cursor of the one that has written most.
    """
    if not storage._is_full:
        return 0
    cursors = [
        (buffer.write_count, buffer.writer._cursor)
        for buffer in storage._attached_entities
        if hasattr(getattr(buffer, "writer", None), "_cursor")
    ]
    return max(cursors, default=(0, 0))[1]


def _flat(index: Tensor | tuple[Tensor, ...], shape: torch.Size) -> Tensor:
    """Indices [B] of rows among all rows, slot after slot."""
    if not isinstance(index, tuple):
        index = (index,) if len(shape) == 1 else index.unbind(-1)
    row = index[0].long()
    for size, coordinate in zip(shape[1:], index[1:], strict=True):
        row = row * size + coordinate
    return row
