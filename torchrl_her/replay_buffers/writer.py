"""Relabeling while writing: whole episodes go in, real and virtual transitions are stored."""

from __future__ import annotations

import warnings
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, is_leaf_nontensor
from torch import Tensor
from torchrl.data.replay_buffers.writers import RoundRobinWriter

from torchrl_her.goals.rewards import RewardFunction
from torchrl_her.goals.weights import GoalWeights
from torchrl_her.replay_buffers.draw import draw_goals
from torchrl_her.replay_buffers.episodes import Episodes, find_episodes
from torchrl_her.replay_buffers.keys import entry_of
from torchrl_her.replay_buffers.options import HindsightBase, HindsightOptions

# Transitions written at once: larger pieces touch fresh memory each time, smaller ones need more calls.
_ROWS = 1 << 17
_MASK = ("collector", "mask")  # TorchRL's mark of trajectories that it split and padded
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
    in the root and under ``next``; its reward, terminated and done are computed again for that goal, and
    everything else stays as it was. Goals never come from another episode or another environment.

    If an environment is reset before its episode ends (``reset_at_each_iter``), use batches [N, T] with
    trajectory ids, which show where such an episode stops. In flat batches it would be held back forever.

    The writer works in any TorchRL replay buffer with a one-dimensional storage, under any sampler; the
    capacity counts real and virtual transitions alike. Random numbers come from the buffer's generator
    (``buffer.set_rng``).

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
        ValueError: a negative ``k`` or an unknown strategy.
        TypeError: ``exclude`` is one key, not a list.
        KeyError: a batch lacks an entry (when extending).

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
        self._loaded = False  # whether the held ones came with a state, and nothing was written since

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
            data: [N, T] with time last; or flat, with trajectory ids, without which all of it is one
                trajectory. Within a trajectory, transitions are in the order of time.

        Returns:
            The index of each incoming transition in the storage, in the incoming shape; -1 if it is held
            back, or if later ones of the same batch have already pushed it out of a small buffer.

        Raises:
            ValueError: the storage has several dimensions, or trajectories were split and padded.
            KeyError: an entry is missing.
        """
        if _MASK in data.keys(True):
            raise ValueError(
                "HERWriter takes batches as they are collected, not split and padded: split_trajs=False"
            )
        if self._storage.ndim > 1:
            raise ValueError(f"HERWriter needs a storage of 1 dimension, got one of {self._storage.ndim}")
        held = self.held_back
        rows, lanes, ids = self._with_held(data)
        ends = entry_of(rows, self._keys.done).reshape(-1)
        if self._loaded and held:
            ends = ends | self._broken(rows, lanes, held)
        episodes, left = find_episodes(lanes, ends, ids)
        cursor, written = self._cursor, 0
        place = lanes.new_full((len(lanes),), -1)  # of each row, in the order of writing
        for piece in episodes.split(self._episodes_at_once(episodes)):
            written += self._write(rows, piece, place, written)
        # Last of all, so that a batch that cannot be written loses nothing that was held back before.
        self._held, self._held_lanes = (rows[left] if len(left) else None), lanes[left]
        self._loaded = False
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

    def state_dict(self) -> dict[str, Any]:
        """The writer's whole state, as tensors and plain data."""
        state = super().state_dict()
        state["held"] = None if self._held is None else self._held.to_dict()
        state["held_lanes"] = self._held_lanes.clone()
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
        self._held_lanes = state_dict["held_lanes"].clone()
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
        self.counts = WriterCounts()
        if self.weights is not None:
            self.weights.clear()

    # The work

    def _with_held(self, data: TensorDictBase) -> tuple[TensorDictBase, Tensor, Tensor | None]:
        """Flat transitions, those held back first; their lanes; trajectory ids if lanes are environments."""
        rows = data.reshape(-1)
        ids = rows.get(self._keys.trajectory, None)
        if data.ndim > 1:
            steps = data.shape[-1]
            lanes = torch.arange(len(rows) // max(steps, 1), device=rows.device).repeat_interleave(steps)
        else:
            one_lane = torch.zeros(len(rows), dtype=torch.int64, device=rows.device)
            lanes = one_lane if ids is None else ids.reshape(-1)
        if self._held is not None:
            rows = torch.cat((self._held, rows))
            lanes = torch.cat((self._held_lanes, lanes))
        if data.ndim == 1 or ids is None:
            return rows, lanes, None
        return rows, lanes, rows.get(self._keys.trajectory).reshape(-1)

    def _broken(self, rows: TensorDictBase, lanes: Tensor, held: int) -> Tensor:
        """Which transitions [n] were held back last in a lane that then continues with another episode."""
        order = lanes.argsort(stable=True)
        last, new = order[:-1], order[1:]
        seam = (lanes[last] == lanes[new]) & (last < held) & (new >= held)
        last, new = last[seam], new[seam]
        joins = [(self._keys.next_achieved, self._keys.achieved), (self._keys.goals[1], self._keys.goals[0])]
        differs = torch.zeros_like(last, dtype=torch.bool)
        for after, before in joins:
            pair = entry_of(rows, after)[last], entry_of(rows, before)[new]
            differs |= (pair[0] != pair[1]).flatten(1).any(1)
        return torch.zeros_like(lanes, dtype=torch.bool).index_fill_(0, last[differs], True)

    def _episodes_at_once(self, episodes: Episodes) -> int:
        rows_of_each = max(1, episodes.rows.shape[1]) * (self.k + 1)
        return max(1, min(_ROWS, self._storage.max_size) // rows_of_each)

    def _write(self, rows: TensorDictBase, episodes: Episodes, place: Tensor, written: int) -> int:
        """Stores the real and virtual transitions of some episodes, and notes where the real ones went."""
        real = episodes.rows[episodes.inside]
        source, goal_source = self._draw(rows, episodes)
        virtual = len(source)
        out = self._build(rows, real, source, self._relabel(rows, source, goal_source) if virtual else {})
        place[real] = torch.arange(written + virtual, written + len(out), device=place.device)
        positive = self._positives(entry_of(out, self._keys.reward)[virtual:])
        self._count(real=len(real), virtual=virtual, real_positive=positive)
        excess = max(0, len(out) - self._storage.max_size)
        self._cursor = (self._cursor + excess) % self._storage.max_size
        self._store(out[excess:])
        return len(out)

    def _build(
        self, rows: TensorDictBase, real: Tensor, source: Tensor, changed: dict[NestedKey, Tensor]
    ) -> TensorDictBase:
        """Virtual transitions, made of ``source`` and the changed entries, and then the real ones.

        If a batch does not fit into the buffer, those in front are the first to be pushed out.
        """
        order = torch.cat((source, real))
        same = rows.exclude(*self._exclude, *changed)
        out = same.apply(partial(_take, index=order), batch_size=order.shape, is_leaf=is_leaf_nontensor)
        for key, value in changed.items():
            entry = entry_of(rows, key).index_select(0, real)
            out.set(key, torch.cat((value.to(entry.dtype).view(-1, *entry.shape[1:]), entry)))
        if self.options.virtual_key is not None:
            marks = torch.arange(len(order), device=order.device) < len(source)
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
            generator=self._rng,
        )

    def _relabel(self, rows: TensorDictBase, source: Tensor, goal_source: Tensor) -> dict[NestedKey, Tensor]:
        """The entries in which virtual transitions differ from the real ones they are made of."""
        achieved = entry_of(rows, self._keys.next_achieved)
        goals = achieved.index_select(0, goal_source)
        reward, terminated = self.reward_fn(achieved.index_select(0, source), goals)
        self._note(rows, source, goals, reward)
        truncated = entry_of(rows, self._keys.truncated).index_select(0, source)
        return self._keys.changes(goals, reward, terminated, truncated)

    def _note(self, rows: TensorDictBase, source: Tensor, goals: Tensor, reward: Tensor) -> None:
        """Counts the rewards of virtual transitions, and tells the weights which goals were written."""
        useful = reward
        if not self.filter_achieved:  # otherwise all are useful
            before = rows.get(self._keys.achieved).index_select(0, source)
            useful = reward[self._keep(before, goals)]
        self._count(virtual_positive=self._positives(reward), useful_virtual_positive=self._positives(useful))
        if self.weights is not None:
            self.weights.update(goals)

    def _count(self, **rows: int) -> None:
        for counts in (self.counts, self.totals):
            for name, number in rows.items():
                setattr(counts, name, getattr(counts, name) + number)

    def _positives(self, reward: Tensor) -> int:
        return int((reward >= self.achieved_reward).count_nonzero())


def _take(entry: Any, index: Tensor) -> Any:
    """Rows of an entry. Torch indexes single numbers several times faster than rows of one number."""
    if not isinstance(entry, Tensor):
        return entry[index]
    if entry.shape[1:].numel() == 1:
        return entry.flatten().index_select(0, index).view(-1, *entry.shape[1:])
    return entry.index_select(0, index)
