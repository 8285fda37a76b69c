"""Relabelling as rows are sampled: the storage holds real rows only, and goals are lent to what is drawn.

The same factors as in the writer (:class:`~torchrl_her.HERWriter`), another place. It pays where the buffer
must stay small (a fifth of the rows), where an episode's goals should be drawn anew each time, or where
a storage holds [T, N] rows; the writer pays where sampling must be as fast as it can be.

Which of TorchRL's hooks, and why. A sampler that wraps another one is no ``PrioritizedSampler`` any more,
and ``update_tensordict_priority`` then silently does nothing. A transform does not know which rows it was
given: their index joins them after all transforms. A subclass that relabels what ``_sample`` gives
comes too late for transforms that build on the goal. So it is a ``SampleUnit``, which is shown index and
storage between drawing and reading, under the buffer's lock, and changes neither; what it chose
is put in by the collate function, which comes before all transforms. Sampler, index and priorities are those
of the real rows, and reading (``buffer[:]``) shows real rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from threading import get_ident
from typing import Any, NamedTuple

import torch
from tensordict import NestedKey, TensorDictBase, is_tensor_collection
from torch import Tensor
from torchrl.data import SampleUnit, Storage

from torchrl_her.goal_weights import GoalWeights, checked_weights
from torchrl_her.goals import RewardFunction, missed
from torchrl_her.row_keys import RowKeys, entry_of, in_root_and_next
from torchrl_her.virtual_goals import Strategy, check_strategy, combine, draw, draw_alike, window

# Likelihoods of goals [rows, T] that are held at once.
_LIKELIHOODS = 1 << 17


@dataclass(frozen=True)
class EpisodeIndex:
    """Where the episodes of a ring of rows lie.

    A run is a stretch of one lane (environment) in which an episode was written without a break. A row has a
    *position*, in the order of lanes and time, and a *place*: the rows of an episode follow each other there.

    Attributes:
        slots: T, the ring's length, as far as it is filled.
        lanes: N, rows in each slot; row ``slot * N + lane`` is the lane's one in that slot.
        oldest: slot of the oldest rows.
        begins: [R] int64, positions at which runs begin, ascending.
        places: [R] int64, the places of these rows.
        ordered_begins: [R] int64, ``begins`` in the order of episodes.
        ordered_places: [R] int64, ``places`` in the order of episodes, ascending.
        first: [E + 1] int64, places at which episodes begin, and the number of all rows.
    """

    slots: int
    lanes: int
    oldest: int
    begins: Tensor
    places: Tensor
    ordered_begins: Tensor
    ordered_places: Tensor
    first: Tensor

    def place(self, row: Tensor) -> Tensor:
        """Places [...] of rows [...]."""
        position = row % self.lanes * self.slots + (row // self.lanes - self.oldest) % self.slots
        run = torch.searchsorted(self.begins, position, right=True) - 1
        return self.places[run] + position - self.begins[run]

    def row(self, place: Tensor) -> Tensor:
        """The rows [...] at places [...]: undoes :meth:`place`."""
        run = torch.searchsorted(self.ordered_places, place, right=True) - 1
        position = self.ordered_begins[run] + place - self.ordered_places[run]
        return (position % self.slots + self.oldest) % self.slots * self.lanes + position // self.slots

    def episode(self, place: Tensor) -> tuple[Tensor, Tensor]:
        """Where the episodes of places [...] begin, and where they end: the place behind their newest row."""
        episode = torch.searchsorted(self.first, place, right=True) - 1
        return self.first[episode], self.first[episode + 1]


def index_episodes(done: Tensor, trajectory: Tensor | None = None, *, oldest: int = 0) -> EpisodeIndex:
    """Finds the episodes of a ring buffer.

    An episode ends at a row that is done, where its lane goes on with another trajectory, and at the newest
    row. Flat rows of one trajectory belong together wherever they lie (a collector's batches, flattened, hold
    a stretch of each environment in turn); without ids they are one stream.

    Args:
        done: [T, N] of bool, time first, N environments; or flat, [T].
        trajectory: ids of the trajectories, integers of the same shape. In flat rows an id may only be used
            again after its episode was done.
        oldest: slot of the oldest row: 0 until the ring is full, then the one that is written over next.

    Returns:
        The index. Rows that were written over are missing from their episodes, and that is all.

    Example:
        >>> # Slots 0 and 1 were written last: trajectory 3 began in slot 4, and goes on in them
        >>> index = index_episodes(torch.zeros(5).bool(), torch.tensor([3, 3, 1, 1, 3]), oldest=2)
        >>> first, end = index.episode(index.place(torch.tensor([0, 2])))
        >>> [index.row(torch.arange(*bounds)).tolist() for bounds in zip(first, end)]
        [[4, 0, 1], [2, 3]]
    """
    slots, rows = len(done), done.numel()
    new = done.roll(1, 0)  # whether the row before was done
    if trajectory is not None:
        new[1:] |= trajectory[1:] != trajectory[:-1]
        new[0] |= trajectory[0] != trajectory[-1]
    new[oldest] = True
    # Only this is put in the order of time: ids take eight times as long to move.
    begins = new.roll(-oldest, 0).t().reshape(-1).nonzero().squeeze(-1)
    lanes, behind = rows // slots, begins.new_tensor([rows])
    if trajectory is None or done.ndim > 1:  # every run is an episode
        first = torch.cat((begins, behind))
        return EpisodeIndex(slots, lanes, oldest, begins, begins, begins, begins, first)
    lengths = begins.diff(append=behind)
    own, order = trajectory[(begins + oldest) % slots].sort(stable=True)
    ordered_begins, ordered_lengths = begins[order], lengths[order]
    ordered_places = ordered_lengths.cumsum(0) - ordered_lengths
    places = torch.empty_like(begins).index_copy_(0, order, ordered_places)
    whole = done[(ordered_begins + ordered_lengths - 1 + oldest) % slots]
    opens = torch.ones_like(whole)
    opens[1:] = (own[1:] != own[:-1]) | whole[:-1]
    first = torch.cat((ordered_places[opens], behind))
    return EpisodeIndex(slots, lanes, oldest, begins, places, ordered_begins, ordered_places, first)


class _Stored(NamedTuple):
    """What was read of a storage, and when."""

    storage: Storage
    state: tuple[int, int]
    before: Tensor  # [n, g], goals achieved before the action
    after: Tensor  # [n, g], those that the action achieved: the candidates
    episodes: EpisodeIndex


class _Chosen(NamedTuple):
    """What is to be changed in a batch."""

    size: int
    rows: Tensor  # [V], places in the batch
    goals: Tensor  # [V, g]


class HERSampleUnit(SampleUnit):
    """Lends goals that were achieved later on to rows as they are sampled.

    A plain writer stores real rows, flat or [T, N] (``ndim=2``), and any sampler draws them. Each row drawn
    becomes virtual with probability k / (k + 1), the share that a writer of k virtual rows has: a new
    desired goal in the root and in ``next``, reward, terminated and done recomputed for it, everything
    else as it was, index and priority weight too. A row whose candidates are all filtered out or of weight 0
    stays real. Hand the buffer both the unit and its :meth:`relabel`, as in the example.

    Candidates are the rows of the same episode that are still stored: the remaining ones of an episode whose
    beginning was written over, and those up to the newest one where an episode goes on (for ``"final"``, too,
    it is the newest so far). Trajectory ids tell flat rows of several environments apart. Samplers of slices
    are served row by row: each row gets a goal of its own. A priority is that of a real row, whatever goal
    it was last measured with.

    Args:
        reward: maps (achieved, desired) goals to (reward, terminated); for instance
            :class:`~torchrl_her.GoalReward`.

    Keyword Args:
        k: virtual rows for each real one, on average; 0 relabels none.
        strategy: ``"future"``, ``"final"`` or ``"episode"``.
        filter_achieved: lend no goal that was already achieved in the state before the action
            (Filtered-HER).
        achieved_reward: the reward of an achieved goal; anything below it is "not achieved".
        weights: prefers some goals to others, and is told of those that were lent; None for all alike. It is
            not told when the buffer is emptied: call its ``clear``. Nor is it part of the buffer's state: it
            has a ``state_dict`` of its own.
        exclude: entries to leave out of batches, in the root and in ``next``: those that hold the real goal.
        generator: source of the random numbers; None for the buffer's (``buffer.set_rng``).
        achieved_goal, desired_goal, observed_reward, terminated, truncated, done, trajectory: keys.
        virtual: key under which rows of a batch are marked; None for no mark.

    Raises:
        ValueError: a negative ``k`` or an unknown strategy; when sampling, weights that cannot be.
        KeyError: the storage lacks an entry (when sampling).
        TypeError: it holds no tensordicts (when sampling).
        RuntimeError: :meth:`relabel` was not handed to the buffer (at the second batch).

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
        reward: RewardFunction,
        *,
        k: int = 4,
        strategy: Strategy = "future",
        filter_achieved: bool = False,
        achieved_reward: float = 0.0,
        weights: GoalWeights | None = None,
        exclude: Sequence[NestedKey] = ("state",),
        generator: torch.Generator | None = None,
        achieved_goal: NestedKey = "achieved_goal",
        desired_goal: NestedKey = "desired_goal",
        observed_reward: NestedKey = "reward",
        terminated: NestedKey = "terminated",
        truncated: NestedKey = "truncated",
        done: NestedKey = "done",
        trajectory: NestedKey = ("collector", "traj_ids"),
        virtual: NestedKey | None = "virtual",
    ) -> None:
        if k < 0:
            raise ValueError(f"k must be at least 0, got {k}")
        check_strategy(strategy)
        self.reward = reward
        self.k = k
        self.strategy: Strategy = strategy
        self.filter_achieved = filter_achieved
        self.achieved_reward = achieved_reward
        self.weights = weights
        self.generator = generator
        self._exclude = in_root_and_next(exclude)
        self._keys = RowKeys.of(
            achieved_goal=achieved_goal,
            desired_goal=desired_goal,
            reward=observed_reward,
            terminated=terminated,
            truncated=truncated,
            done=done,
            trajectory=trajectory,
        )
        self._virtual_key = virtual
        self._stored: _Stored | None = None
        # For each thread: a buffer that prefetches draws and collates several batches at once.
        self._chosen: dict[int, _Chosen] = {}

    # TorchRL's hooks

    def expand(
        self, index: Tensor | tuple[Tensor, ...], info: dict[str, Any], storage: Storage
    ) -> tuple[Tensor | tuple[Tensor, ...], dict[str, Any]]:
        """Chooses the goals of the rows that were drawn, for :meth:`relabel`; index and info stay."""
        if self._chosen.pop(get_ident(), None) is not None:
            raise RuntimeError(
                "the batch before was never relabelled: make the buffer with collate_fn=unit.relabel, too"
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
        """Puts goals into a batch that was just sampled, and all that follows from them.

        Args:
            data: [B], as read from the storage. What was not sampled is given back as it is.

        Returns:
            [B], with the goals chosen by :meth:`expand`, and the mark.
        """
        chosen = self._chosen.pop(get_ident(), None)
        if chosen is None:
            return data
        if data.batch_size != (chosen.size,):
            raise RuntimeError(f"{chosen.size} rows were drawn, but a batch {list(data.shape)} was read")
        out, rows = data.exclude(*self._exclude), chosen.rows
        if self._virtual_key is not None:
            marks = torch.zeros(chosen.size, 1, dtype=torch.bool, device=rows.device)
            out.set(self._virtual_key, marks.index_fill_(0, rows, True))
        if len(rows) == 0:
            return out
        achieved = entry_of(data, self._keys.next_achieved)[rows]
        reward, terminated = self.reward(achieved, chosen.goals)
        truncated = entry_of(data, self._keys.truncated)[rows]
        for key, value in self._keys.changes(chosen.goals, reward, terminated, truncated).items():
            entry = entry_of(data, key)
            value = value.to(entry.dtype).view(len(rows), *entry.shape[1:])
            out.set(key, entry.index_copy(0, rows, value))  # a copy: what was read might be the storage
        return out

    def __getstate__(self) -> dict[str, Any]:
        # As TorchRL does: a generator cannot be copied to another process; what was read can be read again.
        return {**self.__dict__, "generator": None, "_stored": None, "_chosen": {}}

    # How it is done

    def _read(self, storage: Storage) -> _Stored:
        """Goals and episodes of a storage, found again only after it was written."""
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
        first, end = (bound + begin for bound in window(self.strategy, place - begin, behind - begin))
        if self.weights is not None and not self.weights.alike:
            return self._draw_by_likelihood(stored, row, first, end, generator)
        source = episodes.row(draw_alike(first, end, 1, generator=generator).squeeze(-1))
        if not self.filter_achieved:
            return source, None
        # Accepting or rejecting what was proposed alike spares most rows a look at all their candidates.
        again = (~self._keep(stored.before[row], stored.after[source])).nonzero().squeeze(-1)
        valid = torch.ones_like(row, dtype=torch.bool)
        source[again], valid[again] = self._draw_by_likelihood(
            stored, row[again], first[again], end[again], generator
        )
        return source, valid

    def _draw_by_likelihood(
        self, stored: _Stored, row: Tensor, first: Tensor, end: Tensor, generator: torch.Generator | None
    ) -> tuple[Tensor, Tensor]:
        """As :meth:`_draw`, from all candidates, ``first`` to ``end``, of each row."""
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

    def _keep(self, before: Tensor, goals: Tensor) -> Tensor:
        """The filter, [...]: False where a goal [..., g] was already achieved before the action."""
        return missed(self.reward, before, goals, self.achieved_reward)


def _oldest(storage: Storage) -> int:
    """The slot of a storage's oldest rows.

    Asked of the writer, not of the storage: its own last cursor is not restored with a checkpoint. Where
    several buffers share a storage, the one that wrote knows.
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
