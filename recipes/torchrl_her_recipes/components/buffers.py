"""Makes the replay buffer that all runs share, with the writer that relabels and the sampler."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import PrioritizedSampler, TensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import Sampler
from torchrl.data.replay_buffers.scheduler import LinearScheduler
from torchrl.envs import DeviceCastTransform, EnvBase

from torchrl_her.curriculum.normalization import count_inputs
from torchrl_her.curriculum.transforms import ZeroPad
from torchrl_her.curriculum.view import StageView
from torchrl_her.env_keys import PROPOSED, PROPOSED_REACHED
from torchrl_her.goals.rewards import EnvReward, RewardFunction
from torchrl_her.modules.normalization import RunningNorm
from torchrl_her.modules.normalized import NormalizeBatch
from torchrl_her.replay_buffers import PackedStorage, RunsPrioritizedSampler, RunsSampler
from torchrl_her.replay_buffers.keys import in_root_and_next
from torchrl_her.replay_buffers.stage_rules import StageRule
from torchrl_her.replay_buffers.symmetry import AugmentBatch, Shift, Symmetry
from torchrl_her.replay_buffers.writer import HERWriter
from torchrl_her_envs.common.goal_env import goal_env
from torchrl_her_recipes.components.curricula import CurriculumState
from torchrl_her_recipes.components.devices import ON_THE_CPU, Devices
from torchrl_her_recipes.components.goals.space import GoalSpace, KernelSpace
from torchrl_her_recipes.config.groups import HindsightConfig, ReplayConfig
from torchrl_her_recipes.config.recipe import Recipe
from torchrl_her_recipes.config.values import load_name

# Entries of a collected batch that are not stored, since no loss reads them.
_NOT_STORED = (
    "state",
    "achieved_goal",
    "input",
    "is_init",
    "is_success",
    "info",
    "collector",
    PROPOSED,
    PROPOSED_REACHED,
)


def make_buffer(
    recipe: Recipe,
    env: EnvBase,
    generators: Sequence[torch.Generator],
    *,
    space: GoalSpace | KernelSpace | None = None,
    state: CurriculumState | None = None,
    norm: RunningNorm | None = None,
    devices: Devices = ON_THE_CPU,
    capacity: int | None = None,
) -> TensorDictReplayBuffer:
    """Makes the replay buffer that all runs share, with the writer that relabels and the sampler.

    Args:
        recipe: recipe of the runs.
        env: environment of the task.
        generators: random generators, one for each run, on the device of the buffer.

    Keyword Args:
        space: space of the goals, for weights that count goals; None without one.
        state: curriculum and stages of the runs; None without a curriculum.
        norm: statistics that written transitions update and by which sampled transitions are normalized; None
            to sample transitions as they are.
        devices: devices of the buffer and of the learner that samples from it.
        capacity: number of transitions per run; None for the recipe's ``buffer_size``.
    """
    size, task, runs = recipe.replay.buffer_size, goal_env(env), len(generators)
    check_buffer_size(size, runs, env, devices.replay, not_stored=_NOT_STORED)
    size = size if capacity is None else capacity
    make = partial(load_name(recipe.weights.maker), recipe.weights, env=task, space=space)
    weights = [make(seed=seed) for seed in recipe.seeds if recipe.hindsight.algorithm.virtual]
    counted = None
    if norm is not None:
        counted = norm.update if state is None else partial(count_inputs, norm, state.progress)
    buffer = TensorDictReplayBuffer(
        storage=PackedStorage(runs * size, device=devices.replay),
        writer=_make_writer(
            recipe.hindsight,
            env,
            gamma=recipe.learner.gamma,
            weights=[weight for weight in weights if weight is not None] or None,
            runs=runs,
            generators=generators,
            stages=_rules(state, EnvReward.of(env)),
            on_write=counted,
        ),
        sampler=_make_sampler(recipe.replay, recipe.learner.priority_power, generators, size, devices.replay),
        priority_key="td_error",
    )
    if devices.learner != devices.replay:
        buffer.append_transform(DeviceCastTransform(devices.learner, orig_device=devices.replay))
    if state is not None:
        state.set_goals(buffer.writer)
        buffer.append_transform(ZeroPad(state.curriculum, state.progress))
    if recipe.replay.symmetry is not None:
        buffer.append_transform(_make_augmentation(recipe.replay.symmetry, task, state, generators))
    if norm is not None:
        buffer.append_transform(NormalizeBatch(norm))
    return buffer


def _make_writer(options: HindsightConfig, env: EnvBase, **others: Any) -> HERWriter:
    algorithm = options.algorithm
    return HERWriter(
        EnvReward.of(env),
        **_goals(options),
        n_steps=options.n_steps,
        filter_achieved=algorithm.filter,
        redraw=options.redraw,
        refill=options.refill if algorithm.filter else 1,
        exclude=_NOT_STORED,
        **others,
    )


def _rules(state: CurriculumState | None, task: RewardFunction) -> list[StageRule] | None:
    """Returns a rule for relabeling in each stage, if episodes have stages of their own; else None."""
    if state is None or not state.progress.by_episode:
        return None
    rules = [StageRule(stage.reward_fn or task, stage.instructive) for stage in state.curriculum.stages]
    if state.stored_shares is None:
        return rules
    views = [StageView(state.curriculum, number, rule.reward_fn) for number, rule in enumerate(rules)]
    shared = zip(rules, views, state.stored_shares, strict=True)
    return [rule._replace(view=view, share=share) for rule, view, share in shared]


def _goals(options: HindsightConfig) -> dict[str, Any]:
    """Returns the arguments of ``HERWriter`` for the number and the sources of virtual goals."""
    if not options.algorithm.virtual:
        return {"k": 0}
    if options.goal_sources is not None:
        return {"goal_sources": options.goal_sources}
    return {"k": options.k, "strategy": options.strategy}


def _make_augmentation(
    options: Mapping[str, Any],
    task: EnvBase,
    state: CurriculumState | None,
    generators: Sequence[torch.Generator],
) -> AugmentBatch:
    """Makes the transform that mirrors and shifts sampled transitions: the networks' inputs, and the actions.

    Raises:
        ValueError: an option of the symmetry is missing, unknown or out of its range.
    """
    try:
        shifts = [Shift(**shift) for shift in options.get("shifts", ())]
        symmetry = Symmetry(**{**options, "shifts": shifts})
    except TypeError as error:
        raise ValueError(f"{dict(options)!r} is no symmetry: {error}") from error
    width, goal = (task.observation_spec[key].shape[-1] for key in ("observation", "desired_goal"))
    if symmetry.mirror_action and not task.action_spec.dtype.is_floating_point:
        raise ValueError("mirror_action of a symmetry needs continuous actions")
    columns: dict[Any, Any] = {"observation": range(width), "desired_goal": range(width, width + goal)}
    if state is not None:
        columns = {"input": state.curriculum.input_columns}
    return AugmentBatch(
        symmetry,
        columns,
        width + goal,
        actions=task.action_spec.shape[-1],
        stage=None if state is None else partial(_stages, state, len(generators)),
        generators=generators,
    )


def _stages(state: CurriculumState, runs: int, rows: TensorDictBase) -> Tensor:
    """Returns the stage of each sampled transition, [n] int64."""
    if state.progress.by_episode:
        return rows.get("stage").squeeze(-1)
    stages = torch.tensor(state.progress.stages, device=rows.get("action").device)
    return stages.repeat_interleave(rows.numel() // runs)


def rising_beta(sampler: Sampler, end: float | None, epochs: int) -> list[LinearScheduler]:
    """Returns a list with the scheduler that raises ``priority_beta`` each epoch, or [] if it is constant."""
    if end is None or not isinstance(sampler, PrioritizedSampler):
        return []
    return [LinearScheduler(sampler, "beta", end, max(1, epochs - 1))]


def _make_sampler(
    options: ReplayConfig,
    power: float,
    generators: Sequence[torch.Generator],
    capacity: int,
    device: torch.device,
) -> Sampler:
    if options.sampler == "uniform":
        return RunsSampler(capacity, runs=len(generators), generators=generators, device=device)
    # The option alpha is an exponent of absolute TD errors (Schaul et al.), but most of TorchRL's losses
    # write squared errors: their exponent is half of it.
    return RunsPrioritizedSampler(
        capacity,
        alpha=options.priority_alpha / power,
        beta=options.priority_beta,
        runs=len(generators),
        generators=generators,
        device=device,
    )


def check_buffer_size(
    size: int, runs: int, env: EnvBase, device: torch.device, *, not_stored: Sequence[str] = ()
) -> None:
    """Raises a ValueError if a replay buffer for all runs would need more memory than its device has."""
    step = env.fake_tensordict().exclude(*in_root_and_next(not_stored))
    row = sum(entry.numel() * entry.element_size() for entry in step.values(True, True)) // env.numel()
    capacity = memory_of(device)
    if size * runs * row > capacity:
        raise ValueError(
            f"buffer_size={size} needs {size * runs * row / 1e9:.0f} GB for num_runs={runs}, {row} bytes for "
            f"each transition, but {device} has {capacity / 1e9:.0f} GB"
        )


def memory_of(device: torch.device) -> float:
    """Returns the memory of a device in bytes; infinity if it is unknown."""
    if device.type == "cuda" and torch.cuda.device_count():
        return float(torch.cuda.get_device_properties(device).total_memory)
    if device.type != "cpu" or not hasattr(os, "sysconf"):
        return torch.inf
    return float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
