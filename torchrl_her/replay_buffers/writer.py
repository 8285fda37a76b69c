"""Relabeling while writing: whole episodes go in, real and virtual transitions are stored."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Hashable, Sequence
from dataclasses import asdict, replace
from multiprocessing.context import get_spawning_popen
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data.replay_buffers.writers import RoundRobinWriter

from torchrl_her.checks import check_whole, entry_of
from torchrl_her.files.state import StateFile
from torchrl_her.goals.rewards import RewardFunction
from torchrl_her.goals.weights import GoalWeights, WeightsOfRuns, weights_by_run
from torchrl_her.randomness import Generators, check_generators
from torchrl_her.replay_buffers.draw import draw_for_runs
from torchrl_her.replay_buffers.episodes import find_episodes, time_order
from torchrl_her.replay_buffers.keys import device_of, in_root_and_next
from torchrl_her.replay_buffers.neighbors import SHARED, refuse_beside_writer, refuse_stages
from torchrl_her.replay_buffers.options import HindsightBase, HindsightOptions
from torchrl_her.replay_buffers.runs.batches import Batch
from torchrl_her.replay_buffers.runs.counts import WriterCounts, count_rows
from torchrl_her.replay_buffers.runs.pieces import Chunk, split_runs
from torchrl_her.replay_buffers.runs.recent import RecentGoals
from torchrl_her.replay_buffers.runs.rings import Places, Rings
from torchrl_her.replay_buffers.runs.storage import PackedStorage, write_slices
from torchrl_her.replay_buffers.runs.written import WrittenRows, join_rows, real_rows, virtual_rows
from torchrl_her.replay_buffers.stage_rules import StageRule, split_stages
from torchrl_her.replay_buffers.streams import broken, ends_of_held

# Transitions written at once: larger pieces touch fresh memory each time, smaller ones need more calls.
_ROWS = 1 << 17

OnWrite = Callable[[TensorDictBase, list[int], list[int]], Callable[[], None] | None]


class _Draft(NamedTuple):
    """Real and virtual transitions of some episodes before they are written."""

    rows: TensorDictBase  # collected transitions, as the stage shows them
    runs: list[int]
    real: WrittenRows
    virtual: WrittenRows | None
    numbers: list[WriterCounts]  # counts of each run
    weighted: bool  # whether weights are updated with the virtual goals
    ids: int  # number of trajectory ids that the episodes take

    @property
    def counts(self) -> list[int]:
        """Number of transitions of each run, real and virtual."""
        return [counts.real + counts.virtual for counts in self.numbers]


class HERWriter(StateFile, HindsightBase, RoundRobinWriter):
    """Writes each transition as it was, and up to k times more with a goal that was achieved later.

    The writer takes a collector's batch: [N, T] with time last, or flat with trajectory ids. Episodes that
    are still open at the end of a batch are held back until they end. A virtual transition has another
    desired goal in the root and under ``next``. Its reward, terminated and done are computed for that goal,
    and everything else stays as it was. An episode that terminated by a failure, such as a fall, terminates
    for any goal.

    Goals come from the same episode, unless ``goal_sources`` has ``"actual"`` or ``"achieved"``. For these
    the writer remembers goals that were desired and achieved in recent episodes, in all environments of a
    run. They are part of its state, and forgotten when the buffer is emptied.

    Rows of the next batch continue an open episode if they have the same environment id
    (:class:`~torchrl_her.EnvIds`). Without such ids, they continue it if they have the same place in a batch
    [N, T], or the same trajectory id in a flat batch. Ids are needed, and their absence raises an error, if
    environments are reset before their episodes end, or if batches of several collectors share places. If
    you reset environments yourself, call :meth:`end_episodes`.

    With ``per="episode"``, whole virtual episodes are stored, as samplers of slices need them: up to k copies
    of each episode. Each copy has one goal, drawn for its first transition, and its own id under
    ``trajectory_key``. It ends where its goal terminates it, or is truncated at its end.

    One writer may serve R independent runs: ``HERWriter(..., runs=R, generators=...)``. It takes batches
    [R * N, T], R equal blocks in the order of the runs, and the storage is R equal blocks of rows, each of
    them a ring of its own. What is written for a run does not depend on the other runs.

    Episodes from elsewhere, such as demonstrations, are written with :meth:`extend_run`.

    The writer works in any TorchRL replay buffer with a one-dimensional storage, under any sampler that does
    not consume its transitions (those of slices need ``per="episode"``); the capacity counts real and virtual
    transitions alike. Random numbers come from the buffer's generator (``buffer.set_rng``).

    Args:
        reward_fn: maps (achieved, desired) goals to (reward, terminated), for instance
            :class:`~torchrl_her.GoalReward`.
        options: how transitions are relabeled; None for the defaults.

    Keyword Args:
        weights: weights by which goals are drawn; None for equal weights. Weights are updated only after the
            goals of a batch are drawn. For several runs a list, one for each run (``goal_weights``).
        runs: R, the number of independent runs.
        generators: R sources of random numbers; None for the buffer's, with one run only.
        stages: for a curriculum in which each episode has its own stage: a list of rules, one for each
            stage, which take the place of ``reward_fn``. A rule may have all episodes written for its stage,
            whatever stage they were played in. None if episodes have no stages.
        refill: largest number of goals of a transition, as a multiple of k. If the filter leaves some
            transitions without goals, the others get more, so that a run has about k virtual transitions for
            each real one. The number follows the share of transitions that got goals so far. 1 adds none.
        on_write: called as ``on_write(rows, runs, counts)`` before rows are stored: real and virtual
            transitions run after run, the indices of these runs, and their numbers of rows. It may be called
            several times for one batch. If it raises an error, nothing of the batch is stored. It may return
            a function that undoes the call, for rows that could not be stored. See
            :class:`~torchrl_her.modules.RunningNorm`.
        **changes: options by name, as in the example; all are listed in
            :class:`~torchrl_her.HindsightOptions`.

    Raises:
        ValueError: an option is out of its range, or (when extending) another part does not suit the writer.
        TypeError: ``exclude`` is one key, not a list.
        KeyError: a batch lacks an entry (when extending).
        RuntimeError: the buffer was copied to another process.

    Example:
        >>> from tensordict import TensorDict
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

    _cursor: int  # next row of the plain writer, which does not declare its type

    def __init__(
        self,
        reward_fn: RewardFunction,
        options: HindsightOptions | None = None,
        *,
        weights: GoalWeights | Sequence[GoalWeights] | None = None,
        runs: int = 1,
        generators: Sequence[torch.Generator] | None = None,
        stages: Sequence[StageRule] | None = None,
        refill: int = 1,
        on_write: OnWrite | None = None,
        **changes: Any,
    ) -> None:
        self.generators, self.on_write = check_generators(runs, generators), on_write
        self.stages = list(stages or ())
        for rule in self.stages:
            if not isinstance(rule, StageRule):
                raise TypeError(f"stages must be a list of StageRule, got {rule!r} in it")
            if not 0.0 <= rule.share <= 1.0:
                raise ValueError(f"the share of a StageRule must be in [0, 1], got {rule.share}")
        check_whole(refill=refill, least=1)
        self.refill = refill
        run_weights = weights_by_run(weights, runs)
        super().__init__(
            reward_fn, options, weights=run_weights[0] if run_weights and runs == 1 else None, **changes
        )
        if refill > 1 and self.options.per == "episode":
            raise ValueError(f"refill={refill} needs per='transition', got per='episode'")
        self._weights = run_weights  # weights of goals, if they belong to several runs
        self.runs = runs
        # reward functions of runs that do not use ``reward_fn``
        self._own_rewards: dict[int, RewardFunction] = {}
        self._counts, self._totals = ([WriterCounts() for _ in range(runs)] for _ in range(2))
        self._rings = Rings(runs)
        self._held = Batch.none(runs)  # transitions of open episodes
        self._recent = [RecentGoals.none(runs) for _ in range(max(1, len(self.stages)))]  # by stage
        self._episodes = 0  # number of copied episodes so far, if whole episodes are copied
        self._process = os.getpid()
        # Whether, since the last write, held-back rows were loaded, or their episodes ended.
        self._loaded = self._all_over = self._overfull = False

    @property
    def held_back(self) -> int:
        """Number of transitions of open episodes that wait for their end."""
        return len(self._held)

    @property
    def counts(self) -> WriterCounts:
        """Counts of the transitions of all runs written since the buffer was last emptied."""
        return WriterCounts.sum(self._counts)

    @property
    def totals(self) -> WriterCounts:
        """Counts of all transitions of all runs that were ever written."""
        return WriterCounts.sum(self._totals)

    def counts_of(self, run: int) -> WriterCounts:
        """Returns the counts of a run's transitions written since it was last emptied."""
        return self._counts[run]

    def totals_of(self, run: int) -> WriterCounts:
        """Returns the counts of all transitions of a run that were ever written."""
        return self._totals[run]

    @property
    def capacity(self) -> int:
        """Number of rows in each run's block of the storage."""
        return self._storage.max_size // self.runs

    @property
    def sizes(self) -> list[int]:
        """Number of filled rows of each run in the storage."""
        return [len(self._storage)] if self.runs == 1 else list(self._rings.sizes)

    @property
    def goal_weights(self) -> list[GoalWeights]:
        """Weights of each run's goals; empty if there are none."""
        if self.runs > 1:
            return self._weights
        return [] if self.weights is None else [self.weights]

    def reward_of(self, run: int) -> RewardFunction:
        """Returns the reward function of a run."""
        return self._own_rewards.get(run, self.reward_fn)

    def set_reward(self, reward_fn: RewardFunction | None, *, run: int) -> None:
        """Sets the reward function that relabels the next episodes of a run; None for the writer's.

        Raises:
            ValueError: the writer has ``stages``, whose rewards serve all runs.
        """
        if self.stages:
            raise ValueError(f"the reward of run {run} cannot be set: the rules in stages relabel all runs")
        self._own_rewards[run] = reward_fn or self.reward_fn

    # TorchRL's hooks

    def add(self, data: TensorDictBase) -> Tensor:
        """Writes one step of one environment, or of a batch of environments [N]."""
        return self.extend(data.unsqueeze(-1)).squeeze(-1)

    def extend(self, data: TensorDictBase) -> Tensor:
        """Writes all episodes that end in a batch.

        Args:
            data: [N, T] with time last; or flat, with trajectory ids or environment ids. Without ids, the
                batch is one environment's. Within an environment, transitions are in the order of time.

        Returns:
            The index of each incoming transition in the storage, in the incoming shape; -1 if it is held
            back, or if later ones of the same batch have already pushed it out of a small buffer.

        Raises:
            ValueError: the writer cannot work beside another part of the buffer or collector; trajectories
                were split and padded; environments cannot be told apart; goals or rewards (or results of
                the reward function) are not finite or do not fit. Nothing of the batch is written then.
            KeyError: an entry is missing.
            RuntimeError: the buffer was made by another process.
        """
        self._check(data)
        if data.batch_size.numel() == 0:
            return torch.empty(data.shape, dtype=torch.int64, device=device_of(data))
        held = self._held
        batch = Batch.of(data, self._keys, runs=self.runs).after(held)
        index, left, recent = self._write_episodes(batch, len(held))
        # Set last, so that a batch that cannot be written does not lose rows that were held back before.
        self._held, self._recent = batch.take(left), recent
        self._loaded = self._all_over = False
        if not self.stages and not self._own_rewards:
            self._compare_rewards(batch.rows)
        if self.held_back > self._storage.max_size and not self._overfull:
            self._overfull = True
            warnings.warn(
                f"{self.held_back:,} transitions of open episodes wait for their end, more than the buffer's "
                f"{self._storage.max_size:,}: do all episodes end, and do batches of several environments "
                "come as [N, T]? (this warning appears once)",
                stacklevel=2,
            )
        return index.reshape(data.shape)

    def extend_run(self, data: TensorDictBase, run: int = 0) -> Tensor:
        """Writes whole episodes of one of several runs, which its environments did not collect.

        Open episodes that are held back are not ended by this, in any run.

        Args:
            data: [n], one episode after the other, as if of one environment; the last transition is done.
            run: index of the run, from 0.

        Returns:
            The index of each transition in the storage, [n]; -1 as in :meth:`extend`.

        Raises:
            ValueError: there is no such run, the last episode is open, or as in :meth:`extend`.
            RuntimeError: the buffer was made by another process.
        """
        if not 0 <= run < self.runs:
            raise ValueError(f"run must be in [0, {self.runs - 1}], got {run}")
        if data.ndim != 1 or len(data) == 0 or not bool(entry_of(data, self._keys.done)[-1]):
            raise ValueError(
                f"extend_run needs transitions [n], the last of which is done, got {list(data.shape)}"
            )
        self._check(data if self.runs == 1 else data.unsqueeze(0).expand(self.runs, len(data)))
        batch = Batch.of(data, self._keys, runs=1)
        if self.runs > 1:
            batch = replace(batch, run=torch.full_like(batch.ids, run))
        index, _, self._recent = self._write_episodes(batch, 0)
        return index

    def end_episodes(self) -> None:
        """Marks all environments as reset: episodes that are held back end here.

        They are written with the next batch. Call it after ``collector.reset()``.
        """
        self._all_over = True

    def state_dict(self) -> dict[str, Any]:
        """Returns the writer's whole state, as tensors and plain data."""
        state = super().state_dict()
        state["cursors"] = [self._cursor] if self.runs == 1 else list(self._rings.cursors)
        state["sizes"] = self.sizes
        state.update(self._held.state_dict())
        state["recent"] = [recent.state_dict() for recent in self._recent]
        state["episodes"], state["all_over"] = self._episodes, self._all_over
        for name, counts in (("counts", self._counts), ("totals", self._totals)):
            state[name] = [asdict(run_counts) for run_counts in counts]
        state["weights"] = [weights.state_dict() for weights in self.goal_weights]
        return state

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restores the state that :meth:`state_dict` returned.

        Episodes that were held back continue if the collector's state is restored, too
        (:func:`~torchrl_her.trainers.load_collector_state_dict`). They end if the next transitions do not
        continue them.

        Raises:
            ValueError: the state has another number of runs, stages or weights.
        """
        weights, recent = state_dict["weights"], state_dict["recent"]
        for name, own, saved in (
            ("runs", self.runs, state_dict["cursors"]),
            ("stages", len(self._recent), recent),
            ("weights", len(self.goal_weights), weights),
        ):
            if len(saved) != own:
                raise ValueError(f"the state must have {own} {name}, got {len(saved)}")
        super().load_state_dict(state_dict)
        self._rings.cursors, self._rings.sizes = list(state_dict["cursors"]), list(state_dict["sizes"])
        self._held = Batch.from_state(state_dict, runs=self.runs)
        self._recent = [RecentGoals.from_state(saved) for saved in recent]
        self._episodes, self._all_over = state_dict["episodes"], state_dict["all_over"]
        self._loaded = True
        self._counts, self._totals = (
            [WriterCounts(**run_counts) for run_counts in state_dict[name]] for name in ("counts", "totals")
        )
        for own_weights, state in zip(self.goal_weights, weights, strict=True):
            own_weights.load_state_dict(state)

    def _empty(self, empty_write_count: bool = True) -> None:
        super()._empty(empty_write_count)
        self._loaded = self._all_over = False
        self._held = self._held.take(torch.empty(0, dtype=torch.int64))
        for run in range(self.runs):
            self.empty_run(run)

    def empty_run(self, run: int) -> None:
        """Discards all rows of one of several runs, and its open episodes.

        Call :func:`~torchrl_her.replay_buffers.empty_run` instead, which also empties the sampler.
        """
        self._rings.empty(run)
        self._counts[run] = WriterCounts()
        self._held = self._held.without_run(run)
        self._recent = [recent.without_run(run) for recent in self._recent]
        if self.goal_weights:
            self.goal_weights[run].clear()

    def __getstate__(self) -> dict[str, Any]:
        if get_spawning_popen() is not None:
            raise RuntimeError(f"HERWriter cannot be shared between processes: {SHARED}")
        return super().__getstate__()

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__({**state, "_process": os.getpid()})

    # Helpers

    def _check(self, data: TensorDictBase) -> None:
        """Raises an error if this writer cannot write a batch."""
        if os.getpid() != self._process:
            raise RuntimeError(f"HERWriter writes only in the process that made its buffer: {SHARED}")
        refuse_beside_writer("HERWriter", self._storage, data, self.options, runs=self.runs)
        self._keys.check(data, "collected", k=self.k)
        if not self.stages:
            refuse_stages("HERWriter", data, self.options)

    def _write_episodes(self, batch: Batch, held: int) -> tuple[Tensor, Tensor, list[RecentGoals]]:
        """Writes all episodes that end in a batch.

        Args:
            batch: [held + n]; the first ones were held back.
            held: number of rows that were held back.

        Returns:
            ``(index, left, recent)``: where the n new rows are in the storage, the positions in the batch of
            rows of open episodes, and the goals to be remembered.
        """
        rows, run, streams = batch.rows, batch.run, batch.streams()
        order = time_order(streams)
        ends = entry_of(rows, self._keys.done).reshape(-1)
        if self._all_over and held:
            ends = ends | ends_of_held(streams, order, held)
        ends = ends | broken(
            rows, streams, order, ends, self._keys, kind=batch.kind, held=held, resumed=self._loaded
        )
        episodes, left = find_episodes(streams, ends, order)
        if len(left) == 0:
            self._look_at_time(episodes.lengths)
        if self.runs == 1:  # a single run writes at TorchRL's own cursor
            self._rings.cursors[0] = self._cursor
        places = Places(run, len(batch), runs=self.runs, device=streams.device)
        most = self.k * self.refill + 1  # largest number of copies of a transition
        entries = max(1, min(_ROWS, self.capacity) // most), _ROWS // most
        episode_runs = None if run is None else run[episodes.rows[:, :1]].flatten()
        recent, settings, drafts, first_id = list(self._recent), self._settings(), [], self._episodes
        parts = split_stages(rows, episodes, episode_runs, self._keys.stage, self.stages, self._sources())
        for stage, stage_rows, part, run_of in parts:
            recent_goals = recent[stage].after(
                stage_rows, part, run_of, self._keys, sizes=self.options.remembered
            )
            recent[stage] = recent_goals
            for piece in split_runs(part, run_of, settings, each=entries[0], together=entries[1]):
                rule = self.stages[stage] if self.stages else StageRule(self.reward_of(piece.runs[0]))
                chunk = Chunk(stage_rows, run, piece, rule.reward_fn, self.options, self._keys)
                drafts.append(self._draft(chunk, recent_goals, weighted=rule.weighted, first_id=first_id))
                first_id += drafts[-1].ids
        self._commit(drafts, places)
        self._episodes = first_id
        return places.rows(self._rings.cursors, self.capacity)[held:], left, recent

    def _sources(self) -> Generators:
        """Returns each run's source of random numbers; a single run without one has the buffer's."""
        return [self._rng] if self.generators is None else self.generators

    def _settings(self) -> list[Hashable]:
        """Returns the settings of each run; only runs with equal settings are written at once."""
        is_uniform = [weights.is_uniform for weights in self.goal_weights] or [True] * self.runs
        return [(id(self.reward_of(run)), is_uniform[run], self._times(run)) for run in range(self.runs)]

    def _times(self, run: int) -> int:
        """Returns the factor for a run's number of goals, which makes up for transitions without goals."""
        counts = self._counts[run]
        if self.refill == 1 or not counts.real:
            return 1
        return min(self.refill, max(1, round(counts.real / max(1, counts.relabeled))))

    def _draft(self, chunk: Chunk, recent: RecentGoals, *, weighted: bool, first_id: int) -> _Draft:
        """Returns the transitions of some episodes. Nothing is written or counted yet."""
        runs = chunk.piece.runs
        weights = self.goal_weights if weighted else []
        source, goals, relabeled = draw_for_runs(
            chunk,
            weights=self._weights_of_runs() if weights and not weights[runs[0]].is_uniform else None,
            generators=[self._sources()[run] for run in runs],
            recent=recent,
            times=self._times(runs[0]),
        )
        copies = len(source)
        real = real_rows(chunk, first_id=first_id + copies)
        virtual = virtual_rows(chunk, source, goals, first_id=first_id) if copies else None
        numbers = count_rows(chunk, real, virtual, relabeled)
        ids = copies + len(chunk.episodes.lengths) if self.options.per == "episode" else 0
        return _Draft(chunk.rows, runs, real, virtual, numbers, weighted=weighted, ids=ids)

    def _commit(self, drafts: list[_Draft], places: Places) -> None:
        """Stores and counts real and virtual transitions, and notes where the real ones went.

        If a batch does not fit into the buffer, its virtual transitions, which come first, are overwritten. A
        user's functions are called first: if one raises an error, nothing of the batch is stored or counted.
        """
        exclude = [*self._exclude, *in_root_and_next([self._keys.env_ids])]

        def join(draft: _Draft) -> TensorDictBase:
            virtual_key = self.options.virtual_key
            return join_rows(draft.rows, draft.virtual, draft.real, exclude=exclude, virtual_key=virtual_key)

        joined: list[TensorDictBase] = []
        undo: list[Callable[[], None] | None] = []
        try:
            if self.on_write is not None:
                joined = [join(draft) for draft in drafts]
                for out, draft in zip(joined, drafts, strict=True):
                    undo.append(self.on_write(out, draft.runs, draft.counts))
            for draft in drafts:
                if draft.virtual is not None and self.goal_weights and draft.weighted:
                    goals = draft.virtual.changes[self._keys.goals[0]]
                    self._weights_of_runs().update(goals, draft.runs, draft.virtual.counts)
            for place, draft in enumerate(drafts):
                # Without ``on_write``, drafts are joined one by one: joining all first takes more memory.
                self._store(joined[place] if joined else join(draft), draft.runs, draft.counts)
                for run, added in zip(draft.runs, draft.numbers, strict=True):
                    for written in (self._counts, self._totals):
                        written[run] = WriterCounts.sum((written[run], added))
                places.note(draft.runs, draft.real.root.split(draft.real.counts), draft.counts)
        except Exception:
            for back in reversed(undo):
                if callable(back):
                    back()
            raise

    def _weights_of_runs(self) -> WeightsOfRuns:
        """Returns the weights of all runs as one object; there must be weights."""
        return self.goal_weights[0].of_runs(self.goal_weights)

    def _store(self, rows: TensorDictBase, runs: list[int], counts: list[int]) -> None:
        """Writes rows [m], run after run, by slices: far faster than by the plain writer's index."""
        moves, begin = [], 0
        for run, count in zip(runs, counts, strict=True):
            moves += self._rings.moves(run, begin=begin, count=count, capacity=self.capacity)
            begin += count
        self._write_count += sum(move.to.stop - move.to.start for move in moves)
        if self.runs == 1:
            self._cursor = self._rings.cursors[0]
        if self.runs == 1 and not isinstance(self._storage, PackedStorage):
            for move in moves:
                self._storage.set(move.to, rows[move.source])
        else:
            write_slices(self._storage, rows, moves)
        index = [torch.arange(move.to.start, move.to.stop, device=device_of(rows)) for move in moves]
        if self.tracks_generations:
            for move, written in zip(moves, index, strict=True):
                self._bump_generation(written, rows[move.source])
        self._mark_update_entities(torch.cat(index))
