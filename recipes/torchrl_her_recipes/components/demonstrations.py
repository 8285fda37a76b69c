"""Loads the demonstrations of a recipe and prepares them, as rows of a buffer and as starts of episodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torchrl.data import TensorDictReplayBuffer
from torchrl.envs import EnvBase

from torchrl_her.curriculum.switch import enter_stage
from torchrl_her.demonstrations.dataset import Demonstrations
from torchrl_her.demonstrations.replay import MixedReplay, write_demonstrations
from torchrl_her.demonstrations.shown import in_stage, with_reward
from torchrl_her.demonstrations.starts import DemonstrationStarts
from torchrl_her.goals.rewards import EnvReward
from torchrl_her.objectives.cloning import Cloning
from torchrl_her.trainers.checkpoint import buffer_state_dict, load_buffer_state_dict
from torchrl_her_envs.common.goal_env import goal_env
from torchrl_her_recipes.components.curricula import CurriculumState
from torchrl_her_recipes.components.envs import TaskEnvs, action_bounds
from torchrl_her_recipes.components.streams import Stream, generators_of
from torchrl_her_recipes.config.groups import DemonstrationsConfig, HindsightConfig


@dataclass
class RunDemonstrations:
    """The demonstrations of several runs side by side.

    Attributes:
        recorded: the demonstrations that are used, with the goals of the full task.
        env: environment of the task, which gives the rewards of the full task.
        state: curriculum and stages of the runs; None without a curriculum.
        buffer: replay buffer with the demonstrations and their virtual rows; None if batches contain none.
        starts: transform that starts episodes at states of demonstrations, or None.
    """

    recorded: Demonstrations
    env: EnvBase
    state: CurriculumState | None = None
    buffer: TensorDictReplayBuffer | None = None
    starts: DemonstrationStarts | None = None

    def shown(self, run: int) -> Demonstrations:
        """Returns the demonstrations as seen in a run's stage, with the stage's goals and rewards."""
        rule = EnvReward.of(self.env)
        if self.state is None:
            return with_reward(self.recorded, rule)
        progress = self.state.progress
        return in_stage(
            self.recorded, progress.curriculum, progress.stages[run], rule, by_episode=progress.by_episode
        )

    def fill(self, buffer: TensorDictReplayBuffer, runs: int) -> None:
        """Writes the demonstrations for each run into an empty buffer, and keeps the buffer."""
        self.buffer = buffer
        for run in range(runs):
            write_demonstrations(buffer, self.shown(run), run=run)

    def enter_stage(self, run: int) -> None:
        """Rewrites a run's demonstrations with observations and goals of the stage that it has entered."""
        assert self.state is not None
        if self.buffer is not None:
            enter_stage(self.buffer, self.state.progress.stage_of(run), run=run)
            write_demonstrations(self.buffer, self.shown(run), run=run)
        if self.starts is not None:
            self.starts.show(self.shown(run), run=run)

    def mixed_with(self, buffer: TensorDictReplayBuffer, share: float, batch_size: int) -> Any:
        """Returns a buffer whose samples mix rows of ``buffer`` with a share of demonstrations."""
        if self.buffer is None:
            return buffer
        return MixedReplay(buffer, self.buffer, share=share, batch_size=batch_size)

    def state_dict(self) -> dict[str, Any]:
        """Returns the buffer's state. The state of ``starts`` is part of the collector's state instead."""
        return {"buffer": None if self.buffer is None else buffer_state_dict(self.buffer, copy=False)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores the state that :meth:`state_dict` returned. Restore the curriculum's progress first."""
        if self.buffer is not None:
            self.buffer.empty()
            load_buffer_state_dict(self.buffer, state["buffer"])
        if self.state is None:
            return
        if self.buffer is not None:
            self.state.set_goals(self.buffer.writer)
        if self.starts is not None:
            for run in range(self.state.progress.runs):
                self.starts.show(self.shown(run), run=run)


def load_demonstrations(
    options: DemonstrationsConfig,
    envs: TaskEnvs,
    env: EnvBase,
    seeds: Sequence[int],
    state: CurriculumState | None,
) -> RunDemonstrations | None:
    """Loads the demonstrations of a recipe, without filling a buffer; returns None if ``episodes`` is 0.

    Raises:
        ValueError: an option cannot be used with demonstrations, the file cannot be read, or its
            demonstrations are of another task, too few, or without the states that starts need.
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
        if state is not None and state.progress.by_episode:
            raise ValueError(
                f"demonstrations.starts_share={options.starts_share} cannot be used where each episode has a "
                "stage of its own: leave it out, or choose order=threshold"
            )
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
    """Refuses demonstrations that differ from the run in the task, or in widths of observations or goals."""
    if every.task != task:
        raise ValueError(f"{file} holds demonstrations of {every.task}, not of {task}")
    base: Any = goal_env(env)
    if base.info_keys:
        raise ValueError(
            f"rewards of {task} read info (task.options.info_keys), which demonstrations do not have: leave "
            "out the demonstrations"
        )
    for key in ("observation", "achieved_goal", "desired_goal"):
        width, got = base.observation_spec[key].shape[-1], every.rows[key].shape[-1]
        if width != got:
            raise ValueError(
                f"{file} holds demonstrations of {task} with other options: {key!r} of width {got}, "
                f"not {width}"
            )


def _scaled(recorded: Demonstrations, env: EnvBase) -> Demonstrations:
    """Returns demonstrations with actions scaled to the range -1 to 1, which learners use."""
    low, high = action_bounds(env)
    if low.eq(-1).all() and high.eq(1).all():
        return recorded
    action = (recorded.rows["action"] - low) / (high - low) * 2 - 1
    return replace(
        recorded, rows=recorded.rows.copy().set("action", action.to(recorded.rows["action"].dtype))
    )


def make_cloning(options: DemonstrationsConfig) -> Cloning | None:
    """Returns the settings for behavior cloning of demonstrations in the loss; None without cloning."""
    if not options.in_batches or options.bc_weight == 0:
        return None
    return Cloning(weight=options.bc_weight, q_filter=options.q_filter)


def rows_needed(hindsight: HindsightConfig, demonstrations: RunDemonstrations) -> int:
    """Returns the largest number of rows that a run's demonstrations can fill, virtual rows included."""
    copies = sum(hindsight.sources.values()) * hindsight.refill if hindsight.algorithm.virtual else 0
    state = demonstrations.state
    stages = 1 if state is None or state.stored_shares is None else len(state.stored_shares)
    return len(demonstrations.recorded.rows) * (1 + copies) * stages
