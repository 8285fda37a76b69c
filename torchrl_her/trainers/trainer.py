"""The training loop: collect, write, update. It reads no configuration and writes no files."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Protocol, runtime_checkable

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.collectors import BaseCollector
from torchrl.data import TensorDictReplayBuffer
from torchrl.data.replay_buffers.scheduler import ParameterScheduler
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_her.checks import check_finite, check_whole
from torchrl_her.modules.averaging import PolicyAverage
from torchrl_her.replay_buffers.runs.buffer import runs_of, sizes_of
from torchrl_her.replay_buffers.writer import HERWriter
from torchrl_her.trainers.cut import cut_episodes
from torchrl_her.trainers.learner import Learner

_IDLE = -torch.inf  # marks a run that did not learn; NaN would hide runs that diverged


class Schedule(Protocol):
    """Protocol of a part that changes from epoch to epoch and has a state, such as a schedule of epsilon."""

    def step(self) -> None:
        """Moves to the next epoch; called when an epoch has ended."""
        ...


class Replay(Protocol):
    """Protocol of a replay buffer in the training loop: TorchRL's own, or one that mixes several.

    Its length is the number of rows that a single run can learn from. It samples rows of whole batches, R
    equal blocks in the order of the runs, with an entry ``index``.

    Attributes:
        writer: writer of collected batches, for one run or several.
        priority_key: key of new priorities.
    """

    @property
    def writer(self) -> Any: ...

    @property
    def priority_key(self) -> str: ...

    def __len__(self) -> int: ...

    def extend(self, data: TensorDictBase) -> Tensor: ...

    def sample(self, batch_size: int) -> TensorDictBase: ...

    def update_tensordict_priority(self, rows: TensorDictBase) -> None: ...


@runtime_checkable
class CollectsAhead(Protocol):
    """Protocol of a collector that can collect during the gradient steps."""

    def collect_ahead(self) -> None:
        """Starts to collect the next batch, with the present policy."""
        ...


_MUST_BE_FINITE = ("action", "observation", "achieved_goal", "desired_goal", "reward")


def _check_batch(batch: TensorDictBase) -> None:
    """Refuses a batch that has NaN or infinity in entries that networks or rewards read."""
    names = [name for key in _MUST_BE_FINITE for name in (key, ("next", key))]
    entries = {name: batch.get(name, None) for name in names}
    check_finite({f"the collected {name!r}": entry for name, entry in entries.items() if entry is not None})


class Trainer:
    """Trains in epochs of a fixed number of frames, each beginning with fresh episodes.

    Episodes that are still open when an epoch ends are truncated there: their transitions are stored and
    learned from like all others.

    If ``on_batch`` raises an exception in the middle of an epoch, the next call of :meth:`epoch` finishes
    that epoch.

    The same loop trains one run or many independent ones. The environments of R runs are R equal blocks of
    one batch, and one replay buffer holds the rows of all runs.

    Args:
        collector: yields batches [R * E, T] that the exploring policy played. With :class:`CollectsAhead` it
            collects the next batch while this loop learns from the last one.
        buffer: replay buffer, usually with a :class:`~torchrl_her.HERWriter`. For several runs, its writer
            (``HERWriter(..., runs=R)``) and sampler must be for R runs. To learn from demonstrations, pass a
            :class:`~torchrl_her.demonstrations.MixedReplay`.
        learner: learner that makes gradient steps on sampled rows.
        schedules: objects whose ``step`` is called after each epoch, such as exploration and goal weights.

    Keyword Args:
        runs: R, the number of independent runs.
        epoch_frames: environment steps of each run in an epoch. Epochs end with whole batches, so the first n
            epochs together have n times this number, rounded up.
        frames_per_update: environment steps of a run per gradient step; 0.5, for example, means two gradient
            steps per environment step. Gradient steps are made after each collected batch.
        warmup_frames: environment steps of each run before its first gradient step. The gradient steps that
            belong to these frames follow then. With enough frames to end an episode in each environment, all
            runs have transitions to learn from at their first gradient step.
        batch_size: transitions in a gradient step of one run.
        batches_per_sample: gradient steps whose transitions are drawn in one call. Priorities that change
            during these steps count from the next call on.
        average: moving average of the policy's weights, updated after the gradient steps of each batch.

    Raises:
        ValueError: a number is too small, or the buffer is for another number of runs; when running, a batch
            is not finite, has no trajectory ids, or cannot be divided equally among the runs.

    Attributes:
        frames: environment steps of each run so far.
        updates: gradient steps of each run so far.
        epochs: epochs so far.
        in_epoch: whether an epoch has begun and not yet ended.
    """

    def __init__(
        self,
        *,
        collector: BaseCollector,
        buffer: TensorDictReplayBuffer | Replay,
        learner: Learner,
        schedules: Sequence[Schedule] = (),
        runs: int = 1,
        epoch_frames: int = 20_480,
        frames_per_update: float = 20.0,
        warmup_frames: int = 0,
        batch_size: int = 256,
        batches_per_sample: int = 32,
        average: PolicyAverage | None = None,
    ) -> None:
        check_whole(epoch_frames=epoch_frames, batch_size=batch_size, batches_per_sample=batches_per_sample)
        if not 0 < frames_per_update < math.inf:
            raise ValueError(f"frames_per_update must be positive and finite, got {frames_per_update}")
        if runs_of(buffer) != runs:
            raise ValueError(f"there are {runs} runs, but the buffer's writer is for {runs_of(buffer)}")
        self.collector, self.buffer, self.learner, self.runs = collector, buffer, learner, runs
        self.schedules = list(schedules)
        self.epoch_frames, self.frames_per_update = epoch_frames, frames_per_update
        self.warmup_frames = warmup_frames
        self.batch_size, self.batches_per_sample = batch_size, batches_per_sample
        self.average = average
        self.frames = self.updates = self.epochs = 0
        self._credit = 0.0  # gradient steps that the frames so far allow and that were not made yet
        self._measured: list[dict[str, Tensor]] | None = None  # losses and other values of the present epoch
        self._outside = 0  # frames collected by run(), which belong to no epoch

    @property
    def in_epoch(self) -> bool:
        """Whether an epoch is under way."""
        return self._measured is not None

    def epoch(self, on_batch: Callable[[Trainer], None] | None = None) -> dict[str, Tensor]:
        """Runs one epoch, or the rest of one; returns the means [R] of the learner's measurements.

        Args:
            on_batch: called after each batch, for example for a progress bar.
        """
        if self._measured is None:
            self._reset_collector()
            self._measured = []
        end = self._outside + (self.epochs + 1) * self.epoch_frames
        self._work(end, self._measured, on_batch, cut=True)
        measured, self._measured = _means(self._measured), None
        self.epochs += 1
        for schedule in self.schedules:
            schedule.step()
        return measured

    def run(self, frames: int, on_batch: Callable[[Trainer], None] | None = None) -> dict[str, Tensor]:
        """Collects and learns for a number of frames of each run, rounded up to whole batches.

        Episodes that are open at the end continue in the next call, unless that is a call of :meth:`epoch`.
        """
        measured: list[dict[str, Tensor]] = []
        before = self.frames
        try:
            self._work(before + frames, measured, on_batch, cut=False)
        finally:
            self._outside += self.frames - before
        return _means(measured)

    def _reset_collector(self) -> None:
        """Begins new episodes in all environments. Open episodes are truncated and written."""
        self.collector.reset()
        if isinstance(self.buffer.writer, HERWriter):
            self.buffer.writer.end_episodes()

    def _work(
        self,
        end: int,
        measured: list[dict[str, Tensor]],
        on_batch: Callable[[Trainer], None] | None,
        *,
        cut: bool,
    ) -> None:
        """Collects and learns up to a number of frames, and records the learner's measurements.

        ``cut`` truncates the episodes that are open at the end, since a reset follows.
        """
        while self.frames < end:
            batch = self.collector.next()
            _check_batch(batch)
            if ("collector", "traj_ids") not in batch.keys(True):
                raise ValueError("batches need ('collector', 'traj_ids'), to truncate open episodes")
            collected = batch.numel() // self.runs  # frames of one run
            is_last = self.frames + collected >= end
            if not is_last and isinstance(self.collector, CollectsAhead):
                self.collector.collect_ahead()
            if len(batch) % self.runs:
                raise ValueError(f"a batch must have a multiple of runs={self.runs} rows, got {len(batch)}")
            self.buffer.extend(cut_episodes(batch) if cut and is_last else batch)
            self.frames += collected
            self._credit += collected / self.frames_per_update
            measured += self._learn()
            if on_batch is not None:
                on_batch(self)

    def _learn(self) -> list[dict[str, Tensor]]:
        """Makes all gradient steps that the collected frames allow."""
        # Runs must not depend on each other: one that has no rows yet skips its steps.
        if self.frames < self.warmup_frames:
            return []
        idle = [run for run, size in enumerate(sizes_of(self.buffer)) if size == 0]
        measured = []
        while self._credit >= 1.0:
            steps = min(self.batches_per_sample, int(self._credit))
            self._credit -= steps
            if len(idle) < self.runs:
                measured.append(self._learn_from(idle, steps))
                self.updates += steps
        return measured

    def _learn_from(self, idle: list[int], steps: int) -> dict[str, Tensor]:
        """Makes gradient steps; returns measurements, [steps, R] each, with a mark for idle runs."""
        drawn = self.buffer.sample(self.runs * self.batch_size * steps)
        rows = drawn.view(self.runs, -1)
        measured = self.learner.update(rows, steps, idle=idle)
        if self.average is not None:
            self.average.follow(steps, idle=idle)
        self._set_priorities(drawn, rows, idle)
        at = torch.tensor(idle, dtype=torch.int64)
        return {key: value.index_fill(1, at.to(value.device), _IDLE) for key, value in measured.items()}

    def _set_priorities(self, drawn: TensorDictBase, rows: TensorDictBase, idle: list[int]) -> None:
        """Passes the new priorities of sampled transitions to the sampler."""
        key = self.buffer.priority_key
        priority = rows.get(key, None)
        if priority is None:
            return
        priorities = drawn.select("index")
        # The sampler's trees have float32, even if networks have float64.
        priorities.set(key, priority.flatten(0, 1).float())
        if idle:  # the rows of idle runs belong to other runs
            learned = [run for run in range(self.runs) if run not in idle]
            priorities = priorities.view(self.runs, -1)[learned].flatten()
        self.buffer.update_tensordict_priority(priorities)  # does nothing under a sampler without priorities

    def state_dict(self) -> dict[str, Any]:
        """Returns counters, the measurements of the present epoch, and the state of TorchRL's schedulers.

        All other parts keep their own state.
        """
        counters = {
            "frames": self.frames,
            "updates": self.updates,
            "epochs": self.epochs,
            "outside": self._outside,
        }
        measured = None if self._measured is None else _joined(self._measured)
        schedules = [scheduler.state_dict() for scheduler in self._schedulers]
        return {**counters, "credit": self._credit, "measured": measured, "schedules": schedules}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores the state that :meth:`state_dict` returned."""
        self.frames, self.updates, self.epochs = state["frames"], state["updates"], state["epochs"]
        self._credit, self._outside = state["credit"], state["outside"]
        measured = state["measured"]
        self._measured = None if measured is None else [measured] if measured else []
        for scheduler, saved in zip(self._schedulers, state["schedules"], strict=True):
            scheduler.load_state_dict(saved)

    @property
    def _schedulers(self) -> list[ParameterScheduler]:
        return [schedule for schedule in self.schedules if isinstance(schedule, ParameterScheduler)]


def _joined(measured: list[dict[str, Tensor]]) -> dict[str, Tensor]:
    """Joins the steps [..., R] of each entry."""
    if not measured:
        return {}
    # Measurements from before a stop come from a file, so perhaps from another device.
    return {key: torch.cat([step[key].to(last) for step in measured]) for key, last in measured[-1].items()}


def _means(measured: list[dict[str, Tensor]]) -> dict[str, Tensor]:
    """Returns the means [R] of each entry over the steps in which a run learned; NaN where it never did."""
    return {key: _mean(values) for key, values in _joined(measured).items()}


def _mean(values: Tensor) -> Tensor:
    learned = values != _IDLE
    return torch.where(learned, values, 0.0).sum(0) / learned.sum(0)


@torch.no_grad()
def evaluate(
    env: EnvBase, policy: Callable[[TensorDictBase], TensorDictBase], *, max_steps: int
) -> TensorDictBase:
    """Plays greedy episodes, one in each environment of a batch.

    Args:
        env: batch of N environments; not those of the training, whose episodes would be disturbed.
        policy: policy whose exploration is switched off during the episodes.
        max_steps: T, number of steps.

    Returns:
        The rollout [N, T]. Environments whose episode ends early begin another; metrics such as
        :func:`~torchrl_her.success` use the first episode only.
    """
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        return env.rollout(max_steps, policy, break_when_any_done=False)
