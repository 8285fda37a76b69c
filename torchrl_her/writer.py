"""Relabelling as a replay-buffer writer: whole episodes go in, real and virtual rows are stored."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from torch import Tensor
from torchrl.data.replay_buffers.writers import RoundRobinWriter

from torchrl_her.episodes import Episodes, find_episodes
from torchrl_her.goals import RewardFunction
from torchrl_her.virtual_goals import Strategy, candidates, check_strategy, combine, draw

# Goal likelihoods are a table [episodes, T, T]; longer batches are written piece by piece.
_TABLE_ENTRIES = 1 << 21
_STATE_FILE = "her_writer.pt"


class GoalWeights:
    """How useful each achieved goal is as a virtual goal. Subclass it to direct HER.

    The base class weighs all goals alike and remembers nothing.
    """

    def __call__(self, goals: Tensor) -> Tensor:
        """Weights [...] of at least 0 for goals [..., g]."""
        return goals.new_ones(goals.shape[:-1])

    def update(self, goals: Tensor) -> None:
        """Told of the virtual goals [n, g] that were written."""

    def clear(self) -> None:
        """Told that the buffer was emptied."""

    def state_dict(self) -> dict[str, Any]:
        """Tensors and plain data that :meth:`load_state_dict` takes."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Puts back what :meth:`state_dict` gave."""


@dataclass
class WriterCounts:
    """Rows written since the buffer was last emptied. Positive: the goal was achieved there.

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

    Raises:
        ValueError: a negative ``k`` or an unknown strategy.
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
        self.counts = WriterCounts()
        self._exclude = [unravel_key(place) for key in exclude for place in (key, ("next", key))]
        self._achieved_key = unravel_key(achieved_goal)
        self._next_achieved_key = unravel_key(("next", achieved_goal))
        self._goal_keys = (unravel_key(desired_goal), unravel_key(("next", desired_goal)))
        self._reward_key = unravel_key(("next", observed_reward))
        self._terminated_key = unravel_key(("next", terminated))
        self._truncated_key = unravel_key(("next", truncated))
        self._done_key = unravel_key(("next", done))
        self._trajectory_key = unravel_key(trajectory)
        self._virtual_key = virtual
        self._held: TensorDictBase | None = None  # rows of open episodes, oldest first
        self._held_lanes: Tensor = torch.empty(0, dtype=torch.int64)

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
        """
        if self._storage.ndim > 1:
            raise ValueError(f"HERWriter needs a storage of 1 dimension, got one of {self._storage.ndim}")
        held = self.held_back
        rows, lanes, ids = self._with_held(data)
        episodes, left = find_episodes(lanes, rows.get(self._done_key).reshape(-1), ids)
        self._held, self._held_lanes = (rows[left] if len(left) else None), lanes[left]
        cursor, written = self._cursor, 0
        place = lanes.new_full((len(lanes),), -1)  # of each row, in the order of writing
        for piece in episodes.split(self._episodes_at_once(episodes)):
            written += self._write(rows, piece, place, written)
        capacity = self._storage.max_size
        lost = place < max(0, written - capacity)  # -1 among them: not written at all
        index = ((cursor + place) % capacity).masked_fill_(lost, -1)
        return index[held:].reshape(data.shape)

    def state_dict(self) -> dict[str, Any]:
        """All that the writer knows: tensors and plain data."""
        state = super().state_dict()
        state["held"] = None if self._held is None else self._held.to_dict()
        state["held_lanes"] = self._held_lanes.clone()
        state["counts"] = asdict(self.counts)
        state["weights"] = None if self.weights is None else self.weights.state_dict()
        return state

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        super().load_state_dict(state_dict)
        self._held_lanes = state_dict["held_lanes"].clone()
        held = state_dict["held"]
        self._held = None if held is None else TensorDict.from_dict(held, batch_size=self._held_lanes.shape).clone()
        self.counts = WriterCounts(**state_dict["counts"])
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
        """Flat rows with those held back in front, their lanes, and their trajectory ids if lanes are environments."""
        rows = data.reshape(-1)
        ids = rows.get(self._trajectory_key, None)
        if data.ndim > 1:
            steps = data.shape[-1]
            lanes = torch.arange(len(rows) // max(steps, 1), device=rows.device).repeat_interleave(steps)
        else:
            lanes = torch.zeros(len(rows), dtype=torch.int64, device=rows.device) if ids is None else ids.reshape(-1)
        if self._held is not None:
            rows = torch.cat((self._held, rows))
            lanes = torch.cat((self._held_lanes, lanes))
        if data.ndim == 1 or ids is None:
            return rows, lanes, None
        return rows, lanes, rows.get(self._trajectory_key).reshape(-1)

    def _episodes_at_once(self, episodes: Episodes) -> int:
        horizon = max(episodes.rows.shape[1], 1)
        fitting = self._storage.max_size // (horizon * (self.k + 1))
        return max(1, min(_TABLE_ENTRIES // horizon**2, fitting))

    def _write(self, rows: TensorDictBase, episodes: Episodes, place: Tensor, written: int) -> int:
        """Stores the real and virtual rows of some episodes and notes the places of the real ones."""
        inside = episodes.inside
        real = episodes.rows[inside]
        source, goal_source = self._draw(rows, episodes, inside)
        virtual = len(source)
        # Virtual rows first: should a batch not fit the buffer, real rows are the last to be pushed out.
        out = rows.exclude(*self._exclude)[torch.cat((source, real))]
        self._relabel(rows, out, source, goal_source)
        place[real] = torch.arange(written + virtual, written + len(out), device=place.device)
        self.counts.real += len(real)
        self.counts.virtual += virtual
        self.counts.real_positive += int((out.get(self._reward_key)[virtual:] >= self.achieved_reward).sum())
        excess = max(0, len(out) - self._storage.max_size)
        self._cursor = (self._cursor + excess) % self._storage.max_size
        super().extend(out[excess:])
        return len(out)

    def _draw(self, rows: TensorDictBase, episodes: Episodes, inside: Tensor) -> tuple[Tensor, Tensor]:
        """Which rows [V] are written once more, and the rows [V] whose achieved goals they take."""
        if self.k == 0:
            return episodes.lengths.new_empty(0), episodes.lengths.new_empty(0)
        goals = rows.get(self._next_achieved_key)[episodes.rows]
        likelihood = combine(
            candidates(self.strategy, episodes.lengths, episodes.rows.shape[1]),
            None if self.weights is None else self.weights(goals),
            self._keep(rows, episodes, goals) if self.filter_achieved else None,
        )
        index, valid = draw(likelihood, self.k, generator=self._rng)
        valid &= inside
        source = episodes.rows[valid].repeat_interleave(self.k)
        goal_source = episodes.rows.gather(1, index.flatten(1)).view_as(index)[valid].flatten()
        return source, goal_source

    def _keep(self, rows: TensorDictBase, episodes: Episodes, goals: Tensor) -> Tensor:
        """The filter, [E, T, T]: False where s_t already has the goal that t' achieved."""
        before = rows.get(self._achieved_key)[episodes.rows]
        reward, _ = self.reward(before.unsqueeze(2), goals.unsqueeze(1))
        return reward.squeeze(-1) < self.achieved_reward

    def _relabel(self, rows: TensorDictBase, out: TensorDictBase, source: Tensor, goal_source: Tensor) -> None:
        """Gives the first rows of ``out`` their virtual goals, and all that follows from them."""
        n = len(source)
        if self._virtual_key is not None:
            marks = torch.arange(len(out), device=source.device) < n
            out.set(self._virtual_key, marks.unsqueeze(-1))
        if n == 0:
            return
        achieved = rows.get(self._next_achieved_key)
        goals = achieved[goal_source]
        reward, terminated = self.reward(achieved[source], goals)
        for key in self._goal_keys:
            out.get(key)[:n] = goals
        for key, value in (
            (self._reward_key, reward),
            (self._terminated_key, terminated),
            (self._done_key, terminated | out.get(self._truncated_key)[:n].view_as(terminated)),
        ):
            entry = out.get(key)[:n]
            entry.copy_(value.view_as(entry))
        self._count(rows, source, goals, reward)

    def _count(self, rows: TensorDictBase, source: Tensor, goals: Tensor, reward: Tensor) -> None:
        positive = reward >= self.achieved_reward
        before, _ = self.reward(rows.get(self._achieved_key)[source], goals)
        self.counts.virtual_positive += int(positive.sum())
        self.counts.useful_virtual_positive += int((positive & (before < self.achieved_reward)).sum())
        if self.weights is not None:
            self.weights.update(goals)
