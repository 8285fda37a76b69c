"""The demonstrations of a recipe: rows in a buffer of their own, and starts of episodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torchrl.data import TensorDictReplayBuffer
from torchrl.envs import EnvBase

from torchrl_her.curriculum.switch import enter_stage, set_stage_goals
from torchrl_her.demonstrations.dataset import Demonstrations
from torchrl_her.demonstrations.replay import MixedReplay, write_demonstrations
from torchrl_her.demonstrations.shown import in_stage, with_reward
from torchrl_her.demonstrations.starts import DemonstrationStarts
from torchrl_her.objectives.cloning import Cloning
from torchrl_her.trainers.checkpoint import buffer_state_dict, load_buffer_state_dict
from torchrl_her_envs.common.goal_env import goal_env
from torchrl_her_recipes.components.curricula import CurriculumState
from torchrl_her_recipes.components.envs import TaskEnvs, action_bounds, task_reward
from torchrl_her_recipes.components.streams import Stream, generators_of
from torchrl_her_recipes.config.groups import DemonstrationsConfig, HindsightConfig


@dataclass
class RunDemonstrations:
    """The demonstrations of several runs side by side.

    Attributes:
        recorded: demonstrations from the file that are used, with the goals of the full task.
        env: environment of the task; its rewards are used if there is no curriculum.
        state: the curriculum, or None.
        buffer: relabeled rows of the demonstrations; None if batches contain none.
        starts: starts episodes at states of demonstrations; None if no episode does so.
    """

    recorded: Demonstrations
    env: EnvBase
    state: CurriculumState | None = None
    buffer: TensorDictReplayBuffer | None = None
    starts: DemonstrationStarts | None = None

    def shown(self, run: int) -> Demonstrations:
        """Returns the demonstrations with observations and goals of a run's stage, and the task's rewards."""
        rule = task_reward(self.env)
        if self.state is None:
            return with_reward(self.recorded, rule)
        return in_stage(self.recorded, self.state.curriculum, self.state.progress.stages[run], rule)

    def fill(self, buffer: TensorDictReplayBuffer, runs: int) -> None:
        """Writes the rows of all runs into an empty buffer."""
        self.buffer = buffer
        for run in range(runs):
            write_demonstrations(buffer, self.shown(run), run=run)

    def enter_stage(self, run: int) -> None:
        """Replaces a run's demonstrations by the demonstrations of the stage that it has entered."""
        assert self.state is not None
        if self.buffer is not None:
            enter_stage(self.buffer, self.state.progress.stage_of(run), run=run)
            write_demonstrations(self.buffer, self.shown(run), run=run)
        if self.starts is not None:
            self.starts.show(self.shown(run), run=run)

    def mixed_with(self, buffer: TensorDictReplayBuffer, share: float, batch_size: int) -> Any:
        """Returns a buffer in whose batches a share of the rows are demonstrations."""
        if self.buffer is None:
            return buffer
        return MixedReplay(buffer, self.buffer, share=share, batch_size=batch_size)

    def state_dict(self) -> dict[str, Any]:
        """Returns tensors and plain data. The state of ``starts`` is a part of the collector's state."""
        return {"buffer": None if self.buffer is None else buffer_state_dict(self.buffer, copy=False)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores the state that :meth:`state_dict` returned; restore the curriculum's progress before."""
        if self.buffer is not None:
            self.buffer.empty()
            load_buffer_state_dict(self.buffer, state["buffer"])
        if self.state is None:
            return
        for run in range(self.state.progress.runs):
            if self.buffer is not None:
                set_stage_goals(self.buffer.writer, self.state.progress.stage_of(run), run=run)
            if self.starts is not None:
                self.starts.show(self.shown(run), run=run)


def load_demonstrations(
    options: DemonstrationsConfig,
    envs: TaskEnvs,
    env: EnvBase,
    seeds: Sequence[int],
    state: CurriculumState | None,
) -> RunDemonstrations | None:
    """Returns the demonstrations of some runs, still without a buffer; None if ``episodes`` is 0.

    Raises:
        ValueError: an option cannot be used with demonstrations, or the file cannot be read, is of another
            task, has too few episodes, or has no states that episodes could start at.
    """
    if options.episodes == 0:
        return None
    task = envs.task.name
    try:
        every = Demonstrations.load(str(options.file))
    except OSError as error:
        raise ValueError(
            f"demonstrations.file={options.file} cannot be read ({str(error.strerror).lower()}): "
            f"`torchrl-her record {task} --out {options.file}` writes it"
        ) from error
    _check(every, str(options.file), task, env)
    recorded = _scaled(every.first(options.episodes), env).to(getattr(torch, envs.dtype))
    demonstrations = RunDemonstrations(recorded, env, state)
    if options.as_starts:
        if not callable(getattr(goal_env(env), "start_at", None)):
            raise ValueError(
                f"demonstrations.starts_share={options.starts_share} cannot be used with {task}, "
                "whose environments cannot start at given states; leave it out"
            )
        runs = len(seeds)
        demonstrations.starts = DemonstrationStarts(
            [demonstrations.shown(run) for run in range(runs)],
            share=options.starts_share,
            runs=runs,
            generators=generators_of(seeds, Stream.DEMONSTRATED_STARTS),
            width=options.starts_width,
            stride=options.starts_stride,
            threshold=options.starts_threshold,
            samples=options.starts_samples,
        )
    return demonstrations


def _check(every: Demonstrations, file: str, task: str, env: EnvBase) -> None:
    """Refuses demonstrations of another task, or whose observations or goals have other widths."""
    if every.task != task:
        raise ValueError(f"{file} holds demonstrations of {every.task}, not of {task}")
    base: Any = goal_env(env)
    if base.info_keys:
        raise ValueError(
            f"demonstrations hold no info, and rewards of {task} read it (task.options.info_keys): leave one "
            "of them out"
        )
    for key in ("observation", "achieved_goal", "desired_goal"):
        width, got = base.observation_spec[key].shape[-1], every.rows[key].shape[-1]
        if width != got:
            raise ValueError(
                f"{file} holds demonstrations of {task} with other options: {key!r} of width {got}, "
                f"not {width}"
            )


def _scaled(recorded: Demonstrations, env: EnvBase) -> Demonstrations:
    """Returns demonstrations whose actions are scaled to -1 to 1, as learners take them."""
    low, high = action_bounds(env)
    if low.eq(-1).all() and high.eq(1).all():
        return recorded
    action = (recorded.rows["action"] - low) / (high - low) * 2 - 1
    return replace(
        recorded, rows=recorded.rows.copy().set("action", action.to(recorded.rows["action"].dtype))
    )


def make_cloning(options: DemonstrationsConfig) -> Cloning | None:
    """Returns the settings with which losses clone demonstrations; None if losses do not clone them."""
    if not options.in_batches or options.bc_weight == 0:
        return None
    return Cloning(weight=options.bc_weight, q_filter=options.q_filter)


def rows_needed(hindsight: HindsightConfig, demonstrations: Demonstrations) -> int:
    """Returns how many rows a run needs at most for demonstrations, virtual ones among them."""
    copies = sum(hindsight.sources.values()) * hindsight.refill if hindsight.algorithm.virtual else 0
    return len(demonstrations.rows) * (1 + copies)
