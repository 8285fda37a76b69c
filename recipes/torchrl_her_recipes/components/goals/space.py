"""The space that the goals of a task lie in."""

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
from torchrl_her_recipes.config.groups import Group

_SAMPLES = 10_000  # goals that are drawn if goals do not fill a box
_RESETS = 1_000  # episodes whose goals are collected, if the environment has no distribution of goals
MOST_DIMENSIONS = 3  # of a grid


@dataclass(frozen=True)
class GoalSpace:
    """A grid over the goals of a task, and the distribution of the task's own goals on it.

    Attributes:
        grid: cells that cover the goals.
        target_at: returns q* [cells], the task's goals smoothed by a sigma that is in the unit of the goals.
        sigma: the final sigma.
    """

    grid: GoalGrid
    target_at: Callable[[float], Tensor]
    sigma: float

    @property
    def target(self) -> Tensor:
        """q* [cells] at the final sigma, to which reported divergences are measured."""
        return self.target_at(self.sigma)


@dataclass(frozen=True)
class KernelSpace:
    """Goals of the task itself, for weights that use kernel densities instead of a grid.

    Attributes:
        goals: n goals with g coordinates, [n, g].
        sigma: the final sigma, in the unit of the goals.
    """

    goals: Tensor
    sigma: float


def goal_space(options: Group, envs: TaskEnvs, env: EnvBase, num_envs: int) -> GoalSpace | KernelSpace | None:
    """Returns the space of a task's goals: the range that the task states, or a box around sampled goals.

    For kernel densities, the space is a sample of goals. It is None if the options need no space, or if goals
    are merely counted and the task states no range.

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
            f"IBS must not be used on {name}: its goals lie around its start states, so "
            "the goals that it would prefer are achieved without doing anything; choose a throwing task"
        )
    if _without_grid(name, options.estimator, goal_width(task)):
        return _kernel(name, task, options, box, _desired_goals(envs, task, num_envs))
    if box is None:
        return _sampled(task, options, _desired_goals(envs, task, num_envs))
    return _given(name, task, options, *box)


def goal_width(env: Any) -> int:
    """Returns the number of entries of a task's goal."""
    return int(env.observation_spec["desired_goal"].shape[-1])


def _without_grid(task: str, choice: str, width: int) -> bool:
    """Returns whether q* and q are kernel densities, not histograms over a grid."""
    if choice == "grid" and width > MOST_DIMENSIONS:
        raise ValueError(
            f"estimator=grid needs goals of at most {MOST_DIMENSIONS} numbers, and those of {task} have "
            f"{width}; choose estimator=kernel"
        )
    return choice == "kernel" or (choice == "auto" and width > MOST_DIMENSIONS)


def _kernel(task: str, env: Any, options: SequentialIBS, box: Box | None, goals: Tensor) -> KernelSpace:
    """Returns goals of the task. Its default sigma grows with the root of their width, as distances do."""
    if options.recent is not None:
        raise ValueError(
            f"recent={options.recent} has no effect on {task}, where q is a kernel density: leave it out"
        )
    low, high = (goals.amin(0), goals.amax(0)) if box is None else map(goals.new_tensor, box)
    width = float((high - low).max()) or 1.0
    wider = math.sqrt(max(1.0, goals.shape[-1] / MOST_DIMENSIONS)) if options.sigma is None else 1.0
    return KernelSpace(goals, _share(options, env) * width * wider)


def _given(task: str, env: Any, options: Equal, low: Sequence[float], high: Sequence[float]) -> GoalSpace:
    """Returns the range of goals that an environment states."""
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
    """Returns a box around goals of the task, half as wide again on each side."""
    low, high = goals.amin(0), goals.amax(0)
    width = float((high - low).max()) or 1.0
    margin = torch.where(high > low, (high - low) / 2, width / 2)
    # This box is a guess, so goals outside of it count at its edge without a warning.
    grid = GoalGrid(low - margin, high + margin, [options.cells] * goals.shape[-1], warn=False)
    return GoalSpace(grid, partial(sampled_target, grid, goals), _share(options, env) * width)


def _desired_goals(envs: TaskEnvs, env: Any, num_envs: int) -> Tensor:
    """Returns desired goals of episodes, [n, g] of float64."""
    distribution = getattr(env, "goal_distribution", None)
    if distribution is not None:
        return distribution.sample(_SAMPLES, generator=torch.Generator().manual_seed(0)).double()
    with closing(envs.make(num_envs, [Stream.GOAL_SPACE])) as fresh:
        goals = [fresh.reset()["desired_goal"] for _ in range(-(-_RESETS // num_envs))]
    return torch.cat(goals).double()


def _share(options: Equal, env: Any) -> float:
    """Returns the final sigma as a share of the width of the goals' space."""
    return getattr(options, "sigma", None) or env.goal_sigma
