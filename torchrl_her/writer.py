"""Relabelling as a replay-buffer writer: whole episodes go in, real and virtual rows are stored."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, is_leaf_nontensor
from torch import Tensor
from torchrl.data.replay_buffers.writers import RoundRobinWriter

from torchrl_her.episodes import Episodes, find_episodes
from torchrl_her.goal_drawing import draw_goals
from torchrl_her.goal_weights import GoalWeights
from torchrl_her.goals import RewardFunction, missed
from torchrl_her.row_keys import RowKeys, entry_of, in_root_and_next
from torchrl_her.virtual_goals import Strategy, check_strategy

# Work is done piece by piece: pieces that are too large touch fresh memory in every call, pieces that are too
# small pay more for the calls. Rows written at once.
_ROWS = 1 << 17
_MASK = ("collector", "mask")  # TorchRL's mark of trajectories that it split and padded
_STATE_FILE = "her_writer.pt"


@dataclass
class WriterCounts:
    """Rows written. Positive: the goal was achieved there.

    ``useful_virtual_positive`` counts those virtual rows whose goal was not already achieved in
    the state before: the ones that the filter keeps, or would keep.
    """

    real: int = 0
    virtual: int = 0
    real_positive: int = 0
    virtual_positive: int = 0
    useful_virtual_positive: int = 0


class HERWriter(RoundRobinWriter):
    """Writes each transition as it was, and up to k times with a goal achieved later on.

    Takes a collector's batch: [N, T] with time last, or flat with trajectory ids. Episodes that
    are still open at the end of a batch are held back until they close. A virtual row has a new
    desired goal in the root and in ``next``, reward, terminated and done recomputed for it, and
    everything else as it was. Rows never cross an episode or an environment.

    Flat rows of an environment that is reset before its episode ends (``reset_at_each_iter``) wait for an end
    that never comes: batches [N, T] with trajectory ids tell where such episodes stop.

    Works in any TorchRL replay buffer with a one-dimensional storage, under any sampler; the
    capacity counts real and virtual rows alike. Random numbers come from the buffer's generator
    (``buffer.set_rng``).

    Args:
        reward: maps (achieved, desired) goals to (reward, terminated); for instance
            :class:`~torchrl_her.GoalReward`.

    Keyword Args:
        k: virtual rows for each real one; 0 writes none.
        strategy: ``"future"``, ``"final"`` or ``"episode"``.
        filter_achieved: write no virtual row whose goal was already achieved in the state before
            the action (Filtered-HER). What the reward says counts, since many environments never
            terminate.
        achieved_reward: the reward of an achieved goal; anything below it is "not achieved".
        weights: prefers some goals to others; None for all alike.
        exclude: entries not to be stored, in the root and in ``next``. ``state`` is excluded since it
            holds the real goal. Anything else that was computed from the desired goal belongs here too.
        achieved_goal, desired_goal, observed_reward, terminated, truncated, done, trajectory: keys.
        virtual: key under which rows are marked; None for no mark.

    Attributes:
        counts: rows written since the buffer was last emptied.
        totals: rows written ever.
        held_back: rows of open episodes that wait for their end.

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
        >>> buffer.extend(episode).tolist()  # where the real rows went
        [3, 4, 5]
        >>> buffer[:]["desired_goal"].flatten().tolist()
        [3.0, 3.0, 3.0, 9.0, 9.0, 9.0]
        >>> buffer[:]["next", "reward"].flatten().tolist()
        [-1.0, -1.0, 0.0, -1.0, -1.0, -1.0]
    """

    _cursor: int  # where the plain writer writes next; untyped there

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
        super().__init__()
        self.reward = reward
        self.k = k
        self.strategy: Strategy = strategy
        self.filter_achieved = filter_achieved
        self.achieved_reward = achieved_reward
        self.weights = weights
        self.counts, self.totals = WriterCounts(), WriterCounts()
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
        self._held: TensorDictBase | None = None  # rows of open episodes, oldest first
        self._held_lanes: Tensor = torch.empty(0, dtype=torch.int64)
        self._loaded = False  # whether the held rows came with a state, and nothing was written since

    @property
    def held_back(self) -> int:
        """Number of rows of open episodes that wait for their end."""
        return len(self._held_lanes)

    # TorchRL's hooks

    def add(self, data: TensorDictBase) -> Tensor:
        """Writes one step of one environment, or of a batch of environments [N]."""
        return self.extend(data.unsqueeze(-1)).squeeze(-1)

    def extend(self, data: TensorDictBase) -> Tensor:
        """Writes all episodes that a batch closes.

        Args:
            data: [N, T] with time last, or flat, told apart by trajectory ids (one trajectory if
                there are none); within a trajectory in the order of time.

        Returns:
            Where each incoming row went, in the incoming shape; -1 for rows that are held back, or
            that later rows of the same batch pushed out of a small buffer.

        Raises:
            ValueError: a storage of several dimensions, or trajectories that were split and padded.
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
        # Last of all: a batch that cannot be written costs no row that was there before.
        self._held, self._held_lanes = (rows[left] if len(left) else None), lanes[left]
        self._loaded = False
        capacity = self._storage.max_size
        if self.held_back > capacity:
            warnings.warn(
                f"{self.held_back:,} rows of open episodes wait for their end, more than the buffer's "
                f"{capacity:,}: do all episodes end, and do batches of several environments come as [N, T]?",
                stacklevel=2,
            )
        lost = place < max(0, written - capacity)  # -1 among them: not written at all
        index = ((cursor + place) % capacity).masked_fill_(lost, -1)
        return index[held:].reshape(data.shape)

    def state_dict(self) -> dict[str, Any]:
        """All that the writer knows: tensors and plain data."""
        state = super().state_dict()
        state["held"] = None if self._held is None else self._held.to_dict()
        state["held_lanes"] = self._held_lanes.clone()
        state["counts"], state["totals"] = asdict(self.counts), asdict(self.totals)
        state["weights"] = None if self.weights is None else self.weights.state_dict()
        return state

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Puts back what :meth:`state_dict` gave.

        Episodes that were held back go on if the collector goes on with them
        (:func:`~torchrl_her.load_collector_state_dict`); where the next rows do not join onto them, they end.
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

    # How it is done

    def _with_held(self, data: TensorDictBase) -> tuple[TensorDictBase, Tensor, Tensor | None]:
        """Flat rows, those held back in front, their lanes, and trajectory ids if lanes are environments."""
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
        """Which rows [n] are the last held ones of lanes that go on with something else."""
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
        """Stores the real and virtual rows of some episodes and notes the places of the real ones."""
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
        """Virtual rows, made of ``source`` and what changed, and behind them the real rows.

        Should a batch not fit the buffer, the rows in front are the first to be pushed out.
        """
        order = torch.cat((source, real))
        same = rows.exclude(*self._exclude, *changed)
        out = same.apply(partial(_take, index=order), batch_size=order.shape, is_leaf=is_leaf_nontensor)
        for key, value in changed.items():
            entry = entry_of(rows, key).index_select(0, real)
            out.set(key, torch.cat((value.to(entry.dtype).view(-1, *entry.shape[1:]), entry)))
        if self._virtual_key is not None:
            marks = torch.arange(len(order), device=order.device) < len(source)
            out.set(self._virtual_key, marks.unsqueeze(-1))
        return out

    def _store(self, rows: TensorDictBase) -> None:
        """What the plain writer does, but by slices: far faster than with an index for each row."""
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
        """Which rows [V] are written once more, and the rows [V] whose achieved goals they take."""
        if self.k == 0:  # which needs no goals at all
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

    def _keep(self, before: Tensor, goals: Tensor) -> Tensor:
        """The filter, [...]: False where a goal [..., g] was already achieved before the action."""
        return missed(self.reward, before, goals, self.achieved_reward)

    def _relabel(self, rows: TensorDictBase, source: Tensor, goal_source: Tensor) -> dict[NestedKey, Tensor]:
        """The entries of virtual rows that differ from those of the rows they are made of."""
        achieved = entry_of(rows, self._keys.next_achieved)
        goals = achieved.index_select(0, goal_source)
        reward, terminated = self.reward(achieved.index_select(0, source), goals)
        self._note(rows, source, goals, reward)
        truncated = entry_of(rows, self._keys.truncated).index_select(0, source)
        return self._keys.changes(goals, reward, terminated, truncated)

    def _note(self, rows: TensorDictBase, source: Tensor, goals: Tensor, reward: Tensor) -> None:
        """Counts the rewards of virtual rows, and tells the weights of their goals."""
        useful = reward
        if not self.filter_achieved:  # all that the filter keeps is useful
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
    """Rows of an entry. Torch takes numbers several times faster than rows of one number."""
    if not isinstance(entry, Tensor):
        return entry[index]
    if entry.shape[1:].numel() == 1:
        return entry.flatten().index_select(0, index).view(-1, *entry.shape[1:])
    return entry.index_select(0, index)
