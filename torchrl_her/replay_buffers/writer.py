"""Relabeling while writing: whole episodes go in, real and virtual transitions are stored."""

from __future__ import annotations

import os
import warnings
from dataclasses import asdict, dataclass, replace
from functools import partial
from multiprocessing.context import get_spawning_popen
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase, is_leaf_nontensor
from torch import Tensor
from torchrl.data.replay_buffers.writers import RoundRobinWriter

from torchrl_her.goals.rewards import RewardFunction
from torchrl_her.goals.weights import GoalWeights
from torchrl_her.replay_buffers.copies import (
    Copies,
    episode_numbers,
    real_copies,
    virtual_copies,
    virtual_episodes,
    with_ends,
)
from torchrl_her.replay_buffers.draw import draw_goals
from torchrl_her.replay_buffers.episodes import Episodes, find_episodes, time_order
from torchrl_her.replay_buffers.keys import entry_of, in_root_and_next
from torchrl_her.replay_buffers.lanes import BY_ENV, broken, ends_of_held, find_lanes, in_order
from torchrl_her.replay_buffers.neighbors import (
    SHARED,
    has_slices,
    refuse_consuming,
    refuse_n_steps,
    refuse_padded,
    refuse_priorities,
    refuse_slices,
)
from torchrl_her.replay_buffers.options import HindsightBase, HindsightOptions

# Transitions written at once: larger pieces touch fresh memory each time, smaller ones need more calls.
_ROWS = 1 << 17
_STATE_FILE = "her_writer.pt"


@dataclass
class WriterCounts:
    """How many transitions were written; the positive ones are those that achieved their goal.

    ``useful_virtual_positive`` leaves out virtual transitions whose goal was already achieved in the state
    before. It counts what the filter keeps, or would keep if it were on.
    """

    real: int = 0
    virtual: int = 0
    real_positive: int = 0
    virtual_positive: int = 0
    useful_virtual_positive: int = 0


class HERWriter(HindsightBase, RoundRobinWriter):
    """Writes each transition as it was, and up to k times more with a goal that was achieved later.

    It takes a collector's batch: [N, T] with time last, or flat with trajectory ids. Episodes that are still
    open at the end of a batch are held back until they end. A virtual transition has another desired goal
    in the root and under ``next``; its reward, terminated and done are computed again for that goal (but an
    episode that terminated without achieving its goal, as by a fall, does so for any goal), and everything
    else stays as it was. Goals never come from another episode or another environment.

    Rows of the next batch that go on with an open episode are found by the ids of environments
    (:class:`~torchrl_her.EnvIds`), if there are any; otherwise by their place in a batch [N, T], or by
    trajectory ids in a flat one. What that cannot tell apart is refused: environments that are reset before
    their episodes end, and batches of several collectors that share places, need ids of environments. If you
    reset environments yourself, call :meth:`end_episodes`.

    With ``per="episode"``, whole virtual episodes are stored: up to k copies of each episode, each with one
    goal, drawn for its first transition, and each with an id of its own under ``trajectory_key``. A copy ends
    where its goal terminates it, or is truncated at its end. That is what samplers of slices need.

    The writer works in any TorchRL replay buffer with a one-dimensional storage, under any sampler that does
    not consume its transitions (those of slices need ``per="episode"``); the capacity counts real and virtual
    transitions alike. Random numbers come from the buffer's generator (``buffer.set_rng``).

    Args:
        reward_fn: maps (achieved, desired) goals to (reward, terminated), for instance
            :class:`~torchrl_her.GoalReward`.
        options: how transitions are relabeled; None for the defaults.

    Keyword Args:
        weights: prefers some goals to others; None for all alike.
        **changes: options by name, as in the example; all are listed in
            :class:`~torchrl_her.HindsightOptions`.

    Attributes:
        counts: transitions written since the buffer was last emptied.
        totals: transitions ever written.
        held_back: number of transitions of open episodes that wait for their end.

    Raises:
        ValueError: an option cannot be, or (when extending) the writer cannot work beside another part.
        TypeError: ``exclude`` is one key, not a list.
        KeyError: a batch lacks an entry (when extending).
        RuntimeError: the buffer was copied to another process.

    Example:
        >>> from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
        >>> from torchrl_her import GoalReward
        >>> writer = HERWriter(GoalReward(0.5), k=1, strategy="final")
        >>> buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(100), writer=writer, batch_size=4)
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
        >>> buffer.extend(episode).tolist()  # where the real transitions went
        [3, 4, 5]
        >>> buffer[:]["desired_goal"].flatten().tolist()
        [3.0, 3.0, 3.0, 9.0, 9.0, 9.0]
        >>> buffer[:]["next", "reward"].flatten().tolist()
        [-1.0, -1.0, 0.0, -1.0, -1.0, -1.0]
    """

    _cursor: int  # where the plain writer writes next; untyped there

    def __init__(
        self,
        reward_fn: RewardFunction,
        options: HindsightOptions | None = None,
        *,
        weights: GoalWeights | None = None,
        **changes: Any,
    ) -> None:
        super().__init__(reward_fn, options, weights=weights, **changes)
        self.counts, self.totals = WriterCounts(), WriterCounts()
        self._held: TensorDictBase | None = None  # transitions of open episodes, oldest first
        self._held_lanes: Tensor = torch.empty(0, dtype=torch.int64)
        self._held_kind = ""  # what these are known by
        self._episodes = 0  # copies of episodes ever written, if whole ones are
        self._process = os.getpid()
        # Whether the held ones came with a state, or are over, and nothing was written since.
        self._loaded = self._all_over = False

    @property
    def held_back(self) -> int:
        """Number of transitions of open episodes that wait for their end."""
        return len(self._held_lanes)

    # TorchRL's hooks

    def add(self, data: TensorDictBase) -> Tensor:
        """Writes one step of one environment, or of a batch of environments [N]."""
        return self.extend(data.unsqueeze(-1)).squeeze(-1)

    def extend(self, data: TensorDictBase) -> Tensor:
        """Writes all episodes that end in a batch.

        Args:
            data: [N, T] with time last; or flat, with trajectory ids or environment ids, without which all of
                it is one environment's. Within an environment, transitions are in the order of time.

        Returns:
            The index of each incoming transition in the storage, in the incoming shape; -1 if it is held
            back, or if later ones of the same batch have already pushed it out of a small buffer.

        Raises:
            ValueError: the writer cannot work beside another part of the buffer or collector; trajectories
                were split and padded; environments cannot be told apart.
            KeyError: an entry is missing.
            RuntimeError: the buffer was made by another process.
        """
        self._refuse(data)
        if data.batch_size.numel() == 0:
            return torch.empty(data.shape, dtype=torch.int64, device=data.device)
        held = self.held_back
        rows, kind, ids = self._with_held(data)
        lanes = in_order(ids) if kind == BY_ENV else ids
        order = time_order(lanes)
        ends = entry_of(rows, self._keys.done).reshape(-1)
        if self._all_over:
            ends = ends | ends_of_held(lanes, order, held)
        over = broken(rows, lanes, order, ends, self._keys, kind=kind, held=held, resumed=self._loaded)
        episodes, left = find_episodes(lanes, ends | over, order)
        cursor, written = self._cursor, 0
        place = lanes.new_full((len(lanes),), -1)  # of each row, in the order of writing
        for piece in episodes.split(self._episodes_at_once(episodes)):
            written += self._write(rows, piece, place, written)
        # Last of all, so that a batch that cannot be written loses nothing that was held back before.
        self._held = rows[left] if len(left) else None
        self._held_lanes, self._held_kind = ids[left], kind
        self._loaded = self._all_over = False
        capacity = self._storage.max_size
        if self.held_back > capacity:
            warnings.warn(
                f"{self.held_back:,} transitions of open episodes wait for their end, more than the buffer's "
                f"{capacity:,}: do all episodes end, and do batches of several environments come as [N, T]?",
                stacklevel=2,
            )
        lost = place < max(0, written - capacity)  # -1 among them: not written at all
        index = ((cursor + place) % capacity).masked_fill_(lost, -1)
        return index[held:].reshape(data.shape)

    def end_episodes(self) -> None:
        """Tells that all environments were reset, so that episodes which are held back do not go on.

        They are written with the next batch. Call it after ``collector.reset()``.
        """
        self._all_over = True

    def state_dict(self) -> dict[str, Any]:
        """The writer's whole state, as tensors and plain data."""
        state = super().state_dict()
        state["held"] = None if self._held is None else self._held.to_dict()
        state["held_lanes"], state["held_kind"] = self._held_lanes.clone(), self._held_kind
        state["episodes"], state["all_over"] = self._episodes, self._all_over
        state["counts"], state["totals"] = asdict(self.counts), asdict(self.totals)
        state["weights"] = None if self.weights is None else self.weights.state_dict()
        return state

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Puts back what :meth:`state_dict` gave.

        Episodes that were held back go on if the collector does
        (:func:`~torchrl_her.trainers.load_collector_state_dict`). They end if the next transitions do not
        continue them.
        """
        super().load_state_dict(state_dict)
        self._held_lanes, self._held_kind = state_dict["held_lanes"].clone(), state_dict["held_kind"]
        self._episodes, self._all_over = state_dict["episodes"], state_dict["all_over"]
        self._loaded = True
        held, shape = state_dict["held"], self._held_lanes.shape
        self._held = None if held is None else TensorDict.from_dict(held, batch_size=shape).clone()
        self.counts = WriterCounts(**state_dict["counts"])
        self.totals = WriterCounts(**state_dict["totals"])
        if self.weights is not None and state_dict["weights"] is not None:
            self.weights.load_state_dict(state_dict["weights"])

    def dumps(self, path: str | Path) -> None:
        super().dumps(path)
        torch.save(self.state_dict(), Path(path) / _STATE_FILE)

    def loads(self, path: str | Path) -> None:
        super().loads(path)
        self.load_state_dict(torch.load(Path(path) / _STATE_FILE, weights_only=True))

    def _empty(self, empty_write_count: bool = True) -> None:
        super()._empty(empty_write_count)
        self._held, self._held_lanes = None, self._held_lanes[:0]
        self._loaded = self._all_over = False
        self.counts = WriterCounts()
        if self.weights is not None:
            self.weights.clear()

    def __getstate__(self) -> dict[str, Any]:
        if get_spawning_popen() is not None:
            raise RuntimeError(f"HERWriter cannot be shared between processes: {SHARED}")
        return super().__getstate__()

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__({**state, "_process": os.getpid()})

    # The work

    def _refuse(self, data: TensorDictBase) -> None:
        """Raises an error beside parts and batches that would be written wrongly."""
        if os.getpid() != self._process:
            raise RuntimeError(f"HERWriter writes only in the process that made its buffer: {SHARED}")
        refuse_padded("HERWriter", data)
        if self._storage.ndim > 1:
            raise ValueError(f"HERWriter needs a storage of 1 dimension, got one of {self._storage.ndim}")
        refuse_n_steps("HERWriter", data)
        refuse_consuming("HERWriter", self._storage)
        refuse_slices("HERWriter", self._storage)
        refuse_priorities("HERWriter", self._storage, data)
        if not has_slices(self._storage):
            return
        if self.k > 0 and self.options.per == "transition":
            raise ValueError(
                "under a sampler of slices, HERWriter needs per='episode': with per='transition' a slice "
                "would hold copies of one transition for several goals, and no sequence"
            )
        if self.options.n_steps > 1:
            raise ValueError(
                f"under a sampler of slices, HERWriter needs n_steps=1, got {self.options.n_steps}: "
                "the steps of a slice follow each other already"
            )

    def _with_held(self, data: TensorDictBase) -> tuple[TensorDictBase, str, Tensor]:
        """Flat transitions, those held back first; what lanes are known by, and which lane each is of."""
        kind, ids = find_lanes(data, self._keys)
        rows = data.reshape(-1)
        if self._held is None:
            return rows, kind, ids
        if kind != self._held_kind:
            raise ValueError(
                f"episodes that are still open were told apart by {self._held_kind}, this batch by {kind}: "
                "hand over all batches in one form, [N, T] or flat, and with the same ids"
            )
        return torch.cat((self._held, rows)), kind, torch.cat((self._held_lanes, ids))

    def _episodes_at_once(self, episodes: Episodes) -> int:
        rows_of_each = max(1, episodes.rows.shape[1]) * (self.k + 1)
        return max(1, min(_ROWS, self._storage.max_size) // rows_of_each)

    def _write(self, rows: TensorDictBase, episodes: Episodes, place: Tensor, written: int) -> int:
        """Stores the real and virtual transitions of some episodes, and notes where the real ones went.

        If a batch does not fit into the buffer, the virtual ones in front are the first to be pushed out.
        """
        n_steps, gamma = self.options.n_steps, self.options.gamma
        real = real_copies(rows, episodes, self._keys, n_steps=n_steps, gamma=gamma)
        source, goal_source = self._draw(rows, episodes)
        parts = [real]
        if len(source) > 0:
            goals = entry_of(rows, self._keys.next_achieved).index_select(0, goal_source)
            if self.options.per == "episode":
                virtual, copy = virtual_episodes(
                    rows,
                    episodes,
                    source,
                    goals,
                    self.reward_fn,
                    self._keys,
                    achieved_reward=self.achieved_reward,
                )
                virtual = self._with_ids(virtual, copy, len(source))
            else:
                virtual = virtual_copies(
                    rows,
                    episodes,
                    source,
                    goals,
                    self.reward_fn,
                    self._keys,
                    achieved_reward=self.achieved_reward,
                    n_steps=n_steps,
                    gamma=gamma,
                )
            self._note(rows, virtual)
            parts = [virtual, real]
        if self.options.per == "episode":
            real = with_ends(real, rows, episodes, self._keys)
            parts[-1] = self._with_ids(real, episode_numbers(episodes), len(episodes.lengths))
        out = self._build(rows, parts)
        behind = len(out) - len(real.root)
        place[real.root] = torch.arange(written + behind, written + len(out), device=place.device)
        self._count(real=len(real.root), virtual=behind, real_positive=self._positives(real.reward))
        excess = max(0, len(out) - self._storage.max_size)
        self._cursor = (self._cursor + excess) % self._storage.max_size
        self._store(out[excess:])
        return len(out)

    def _with_ids(self, copies: Copies, number: Tensor, count: int) -> Copies:
        """The same with trajectory ids that no other stored episode has, real or virtual."""
        first, self._episodes = self._episodes, self._episodes + count
        return replace(copies, changes={**copies.changes, self._keys.trajectory: number + first})

    def _build(self, rows: TensorDictBase, parts: list[Copies]) -> TensorDictBase:
        """Transitions, part after part; the last part is that of the real ones."""
        changed = list(dict.fromkeys(key for part in parts for key in part.changes))
        env_ids = in_root_and_next([self._keys.env_ids])
        same = rows.exclude(*self._exclude, *env_ids, *changed)
        root = torch.cat([part.root for part in parts])
        if self.options.n_steps == 1:
            out = _rows(same, root)
        else:
            out = _rows(same.exclude("next"), root)
            out.set("next", _rows(same.get("next"), torch.cat([part.last for part in parts])))
        for key in changed:
            out.set(key, torch.cat([part.entry(rows, key) for part in parts]))
        if self.options.virtual_key is not None:
            marks = torch.arange(len(root), device=root.device) < len(root) - len(parts[-1].root)
            out.set(self.options.virtual_key, marks.unsqueeze(-1))
        return out

    def _store(self, rows: TensorDictBase) -> None:
        """Writes as the plain writer does, but slice by slice: far faster than with an index for each."""
        room = self._storage.max_size - self._cursor
        for part in (rows[:room], rows[room:]):  # up to the storage's end, then on from its start
            if len(part) > 0:
                place = slice(self._cursor, self._cursor + len(part))
                self._cursor = place.stop % self._storage.max_size
                self._write_count += len(part)
                self._storage.set(place, part)
                index = torch.arange(place.start, place.stop, device=rows.device)
                self._bump_generation(index, part)
                self._mark_update_entities(index)

    def _draw(self, rows: TensorDictBase, episodes: Episodes) -> tuple[Tensor, Tensor]:
        """The transitions [V] to write once more, and those [V] whose achieved goals they take."""
        if self.k == 0:  # then the batch may be without goals
            return episodes.lengths[:0], episodes.lengths[:0]
        return draw_goals(
            entry_of(rows, self._keys.achieved),
            entry_of(rows, self._keys.next_achieved),
            episodes,
            self.k,
            strategy=self.strategy,
            weights=self.weights,
            keep=self._keep if self.filter_achieved else None,
            per=self.options.per,
            generator=self._rng,
        )

    def _note(self, rows: TensorDictBase, virtual: Copies) -> None:
        """Counts the rewards of virtual transitions, and tells the weights which goals were written."""
        useful, goals = virtual.reward, virtual.changes[self._keys.goals[0]]
        if not self.filter_achieved:  # otherwise all are useful
            before = entry_of(rows, self._keys.achieved).index_select(0, virtual.root)
            useful = useful[self._keep(before, goals)]
        self._count(
            virtual_positive=self._positives(virtual.reward), useful_virtual_positive=self._positives(useful)
        )
        if self.weights is not None:
            self.weights.update(goals)

    def _count(self, **rows: int) -> None:
        for counts in (self.counts, self.totals):
            for name, number in rows.items():
                setattr(counts, name, getattr(counts, name) + number)

    def _positives(self, reward: Tensor) -> int:
        return int((reward >= self.achieved_reward).count_nonzero())


def _rows(transitions: TensorDictBase, index: Tensor) -> TensorDictBase:
    out = transitions.apply(partial(_take, index=index), batch_size=index.shape, is_leaf=is_leaf_nontensor)
    return TensorDict(batch_size=index.shape, device=index.device) if out is None else out


def _take(entry: Any, index: Tensor) -> Any:
    """Rows of an entry. Torch indexes single numbers several times faster than rows of one number."""
    if not isinstance(entry, Tensor):
        return entry[index]
    if entry.shape[1:].numel() == 1:
        return entry.flatten().index_select(0, index).view(-1, *entry.shape[1:])
    return entry.index_select(0, index)
