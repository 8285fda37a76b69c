"""The loop: collect, write, update. No configuration, no files, no printing."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.collectors import BaseCollector
from torchrl.data import TensorDictReplayBuffer
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_her.losses import Learner

_IDLE = -torch.inf  # what a run has measured that learnt nothing; NaN would hide those that diverged


class Schedule(Protocol):
    """What changes from epoch to epoch; has state of its own."""

    def step(self) -> None:
        """One epoch has ended."""
        ...


def check_finite(batch: TensorDictBase, keys: tuple[str, ...] = ("action", "observation")) -> None:
    """Raises a ValueError that names the entry if a batch holds NaN or infinite numbers."""
    for key in keys:
        for name in (key, ("next", key)):
            value = batch.get(name, None)
            if value is not None and not bool(value.isfinite().all()):
                raise ValueError(f"the collected {name!r} must be finite, got NaN or infinity in it")


class Trainer:
    """Trains in epochs of a fixed number of frames, each beginning with fresh episodes.

    That epochs begin afresh is what lets a run go on exactly from a checkpoint between two of
    them: nothing of a half-played episode needs to be kept.

    One loop serves a single run and many independent ones. The environments of R runs are R equal
    blocks of one batch; each run has a replay buffer of its own.

    Args:
        collector: yields batches [R * E, T] of the exploring policy.
        buffers: one for each of R runs, usually with a :class:`~torchrl_her.HERWriter`.
        learner: learns from what is sampled.
        schedules: take a step after each epoch: exploration, weights of goals.

    Keyword Args:
        epoch_frames: environment steps of each run in an epoch, rounded up to whole batches.
        frames_per_update: environment steps of each run for each of its gradient steps.
        warmup_frames: environment steps of each run before its first gradient step; the steps that
            they pay for follow then. As many as it takes to end an episode in each environment keep
            runs apart from the first step on.
        batch_size: rows of a gradient step of one run.
        updates_per_draw: gradient steps whose rows are drawn in one call. Their priorities are as
            old as the call.

    Raises:
        ValueError: when running, if what was collected is not finite or has no trajectory ids.

    Attributes:
        frames: environment steps of each run so far.
        updates: gradient steps of each run so far.
        epochs: epochs so far.
    """

    def __init__(
        self,
        *,
        collector: BaseCollector,
        buffers: Sequence[TensorDictReplayBuffer],
        learner: Learner,
        schedules: Sequence[Schedule] = (),
        epoch_frames: int = 20_480,
        frames_per_update: float = 20.0,
        warmup_frames: int = 0,
        batch_size: int = 256,
        updates_per_draw: int = 8,
    ) -> None:
        self.collector, self.buffers, self.learner = collector, buffers, learner
        self.schedules = list(schedules)
        self.epoch_frames, self.frames_per_update = epoch_frames, frames_per_update
        self.warmup_frames = warmup_frames
        self.batch_size, self.updates_per_draw = batch_size, updates_per_draw
        self.frames = self.updates = self.epochs = 0
        self._credit = 0.0  # gradient steps that frames have paid for

    def epoch(self, on_batch: Callable[[Trainer], None] | None = None) -> dict[str, Tensor]:
        """Runs one epoch and returns the means of what the learner measured, [R] each.

        Args:
            on_batch: called after each batch, for a progress bar.
        """
        self.collector.reset()
        end = (self.epochs + 1) * self.epoch_frames  # also where an interrupted epoch is finished
        measured = self.run(end - self.frames, on_batch)
        self.epochs += 1
        for schedule in self.schedules:
            schedule.step()
        return measured

    def run(self, frames: int, on_batch: Callable[[Trainer], None] | None = None) -> dict[str, Tensor]:
        """Collects and learns for a number of frames of each run, rounded up to whole batches."""
        end = self.frames + frames
        measured: list[dict[str, Tensor]] = []
        while self.frames < end:
            batch = self.collector.next()
            check_finite(batch)
            if ("collector", "traj_ids") not in batch.keys(True):
                raise ValueError("the collector must mark trajectories: episodes are cut where epochs begin")
            collected = self._write(batch)
            self.frames += collected
            self._credit += collected / self.frames_per_update
            measured += self._learn()
            if on_batch is not None:
                on_batch(self)
        keys = measured[0] if measured else {}
        return {key: _mean([m[key] for m in measured]) for key in keys}

    def _write(self, batch: TensorDictBase) -> int:
        """Gives each run its block of environments, and returns the frames of one run."""
        blocks = batch.chunk(len(self.buffers))
        for buffer, block in zip(self.buffers, blocks, strict=True):
            buffer.extend(block)
        return blocks[0].numel()

    def _learn(self) -> list[dict[str, Tensor]]:
        """All gradient steps that the collected frames have paid for."""
        # How full another run's buffer is must not matter: a run whose buffer is empty lets its steps pass.
        if self.frames < self.warmup_frames:
            return []
        idle = [run for run, buffer in enumerate(self.buffers) if len(buffer) == 0]
        measured = []
        while self._credit >= 1.0:
            steps = min(self.updates_per_draw, int(self._credit))
            self._credit -= steps
            if len(idle) < len(self.buffers):
                measured.append(self._learn_from(idle, steps))
                self.updates += steps
        return measured

    def _learn_from(self, idle: list[int], steps: int) -> dict[str, Tensor]:
        """Some gradient steps of all runs but the idle ones: [steps, R] each, -inf for those."""
        size = self.batch_size * steps
        drawn = [None if run in idle else buffer.sample(size) for run, buffer in enumerate(self.buffers)]
        stand_in = next(rows for rows in drawn if rows is not None)
        rows = torch.stack([stand_in if own is None else own for own in drawn])
        measured = self.learner.update(rows, steps, idle=idle)
        self._set_priorities(drawn, rows)
        nothing = torch.tensor(idle, dtype=torch.int64)
        return {key: value.index_fill(1, nothing, _IDLE) for key, value in measured.items()}

    def _set_priorities(self, drawn: list[TensorDictBase | None], rows: TensorDictBase) -> None:
        """Tells each run's sampler the new priorities of the rows that were learnt from."""
        key = self.buffers[0].priority_key
        priorities = rows.get(key, None)
        if priorities is None:
            return
        for buffer, own, priority in zip(self.buffers, drawn, priorities, strict=True):
            if own is not None:
                own.set(key, priority.float())  # what TorchRL's trees hold, also for networks in float64
                buffer.update_tensordict_priority(own)  # does nothing under a sampler without priorities

    def state_dict(self) -> dict[str, Any]:
        """The counters; the parts have state of their own."""
        return {"frames": self.frames, "updates": self.updates, "epochs": self.epochs, "credit": self._credit}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Puts the counters back."""
        self.frames, self.updates, self.epochs = state["frames"], state["updates"], state["epochs"]
        self._credit = state["credit"]


def _mean(measured: list[Tensor]) -> Tensor:
    """The means [R] over all steps [..., R] in which a run learnt; NaN where it never did."""
    values = torch.cat(measured)
    learnt = values != _IDLE
    return torch.where(learnt, values, 0.0).sum(0) / learnt.sum(0)


@torch.no_grad()
def evaluate(
    env: EnvBase, policy: Callable[[TensorDictBase], TensorDictBase], *, max_steps: int
) -> TensorDictBase:
    """Plays greedy episodes, one in each environment of a batch.

    Args:
        env: batched, [N]; an environment of its own, so that training is not disturbed.
        policy: exploration inside of it is switched off.
        max_steps: T.

    Returns:
        The rollout [N, T]; environments that end early go on, see :mod:`torchrl_her.metrics`.
    """
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        return env.rollout(max_steps, policy, break_when_any_done=False)
