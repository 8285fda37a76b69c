"""Finds the space in which the goals of a task lie, for weights that count goals or estimate densities."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_her.goals.grid import GoalGrid, box_target, sampled_target
from torchrl_her_envs.common.goal_env import Box, goal_env
from torchrl_her_recipes.components.envs import TaskEnvs
from torchrl_her_recipes.components.streams import Stream
from torchrl_her_recipes.config.choices.weights import Equal, SequentialIBS
from torchrl_her_recipes.config.options import Group

_SAMPLES = 10_000  # number of goals that are drawn from a distribution that is not uniform in a box
_RESETS = 1_000  # number of resets whose goals are collected if the environment states no distribution
MOST_DIMENSIONS = 3  # largest number of dimensions of a grid


@dataclass(frozen=True)
class GoalSpace:
    """A grid over the goals of a task, and the distribution of the task's own goals on it.

    Attributes:
        grid: cells that cover the goals.
        target_at: function of sigma that returns q* [cells], the distribution of the task's goals smoothed by
            a Gaussian of this sigma, in the unit of the goals.
        sigma: the final sigma.
    """

    grid: GoalGrid
    target_at: Callable[[float], Tensor]
    sigma: float

    @property
    def target(self) -> Tensor:
        """q* [cells] at the final sigma, the reference of reported divergences."""
        return self.target_at(self.sigma)


@dataclass(frozen=True)
class KernelSpace:
    """A sample of a task's own goals, for weights that use kernel densities instead of a grid.

    Attributes:
        goals: [n, g], n goals with g coordinates.
        sigma: the final sigma, in the unit of the goals.
    """

    goals: Tensor
    sigma: float


def goal_space(options: Group, envs: TaskEnvs, env: EnvBase, num_envs: int) -> GoalSpace | KernelSpace | None:
    """Returns the space of a task's goals, as the options need it.

    A :class:`GoalSpace` covers the range of goals that the task states or, if it states none, a box around
    sampled goals. For kernel densities, a :class:`KernelSpace` has a sample of goals. None is returned if the
    options need no space, or if goals are only counted (equal weights) and the task states no range.

    Args:
        options: Options of weights or of behavior goals.
        envs: Maker of the task's environments.
        env: Environments of the task.
        num_envs: Number of environments that are reset to collect goals, if the task states no distribution.

    Raises:
        ValueError: the options prefer instructive goals, but the goals of the task lie around its start
            states; or the options choose a grid, but goals have too many coordinates for a grid.
    """
    if not isinstance(options, Equal):
        return None
    name, task, box = envs.task.name, goal_env(env), goal_env(env).goal_box()
    if not isinstance(options, SequentialIBS):
        return None if box is None else _given(name, task, options, *box)
    if task.starts_near_goals:
        raise ValueError(
            f"IBS must not be used on {name}: the goals of this task lie around its start states, so the "
            "goals that IBS prefers would be achieved without any action; choose a throwing task"
        )
    if _without_grid(name, options.estimator, goal_width(task)):
        return _kernel(name, task, options, box, _desired_goals(envs, task, num_envs))
    if box is None:
        return _sampled(task, options, _desired_goals(envs, task, num_envs))
    return _given(name, task, options, *box)


def goal_width(env: Any) -> int:
    """Returns the number of coordinates of a task's goals."""
    return int(env.observation_spec["desired_goal"].shape[-1])


def _without_grid(task: str, choice: str, width: int) -> bool:
    """Returns whether q* and q are estimated by kernel densities instead of histograms over a grid."""
    if choice == "grid" and width > MOST_DIMENSIONS:
        raise ValueError(
            f"estimator=grid needs goals of at most {MOST_DIMENSIONS} numbers, and those of {task} have "
            f"{width}; choose estimator=kernel"
        )
    return choice == "kernel" or (choice == "auto" and width > MOST_DIMENSIONS)


def _kernel(task: str, env: Any, options: SequentialIBS, box: Box | None, goals: Tensor) -> KernelSpace:
    """Makes the space for kernel densities; its default sigma grows with the number of goal coordinates."""
    if options.recent is not None:
        raise ValueError(
            f"recent={options.recent} has no effect on {task}, where q is a kernel density: leave it out"
        )
    low, high = (goals.amin(0), goals.amax(0)) if box is None else map(goals.new_tensor, box)
    width = float((high - low).max()) or 1.0
    wider = math.sqrt(max(1.0, goals.shape[-1] / MOST_DIMENSIONS)) if options.sigma is None else 1.0
    return KernelSpace(goals, _share(options, env) * width * wider)


def _given(task: str, env: Any, options: Equal, low: Sequence[float], high: Sequence[float]) -> GoalSpace:
    """Makes a grid over the range of goals that an environment states."""
    goals = env.goal_distribution
    grid = GoalGrid(low, high, [options.cells] * len(low))
    target: Callable[[float], Tensor]
    if goals.is_box and bool((goals.high > goals.low).all()):
        target = partial(box_target, grid, goals.low, goals.high, name=task)
    else:
        samples = goals.sample(_SAMPLES, generator=torch.Generator().manual_seed(0))
        target = partial(sampled_target, grid, samples)
    return GoalSpace(grid, target, _share(options, env) * max(b - a for a, b in zip(low, high, strict=True)))


def _sampled(env: Any, options: SequentialIBS, goals: Tensor) -> GoalSpace:
    """Makes a grid over a box around sampled goals, with a margin of half their range on each side."""
    low, high = goals.amin(0), goals.amax(0)
    width = float((high - low).max()) or 1.0
    margin = torch.where(high > low, (high - low) / 2, width / 2)
    # The box is a guess, so goals outside of it are expected: they count at its edge without a warning.
    grid = GoalGrid(low - margin, high + margin, [options.cells] * goals.shape[-1], warn=False)
    return GoalSpace(grid, partial(sampled_target, grid, goals), _share(options, env) * width)


def _desired_goals(envs: TaskEnvs, env: Any, num_envs: int) -> Tensor:
    """Returns a sample of the task's desired goals, [n, g] of float64."""
    distribution = getattr(env, "goal_distribution", None)
    if distribution is not None:
        return distribution.sample(_SAMPLES, generator=torch.Generator().manual_seed(0)).double()
    with closing(envs.make(num_envs, [Stream.GOAL_SPACE])) as fresh:
        goals = [fresh.reset()["desired_goal"] for _ in range(-(-_RESETS // num_envs))]
    return torch.cat(goals).double()


def _share(options: Equal, env: Any) -> float:
    """Returns the final sigma as a fraction of the range of goals: the option, or the task's default."""
    return getattr(options, "sigma", None) or env.goal_sigma
