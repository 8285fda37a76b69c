"""Makes the environments of a recipe, and plays episodes in them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Bounded
from torchrl.envs import ActionScaling, Compose, EnvBase, Transform, TransformedEnv

from torchrl_her.goals.rewards import EnvReward
from torchrl_her.trainers.trainer import evaluate
from torchrl_her_envs.common.goal_env import goal_env, reward_range
from torchrl_her_envs.registry import GYM, get_task_spec, make_env
from torchrl_her_recipes.components.failures import Failures
from torchrl_her_recipes.config.groups import CurriculumConfig, TaskConfig
from torchrl_her_recipes.config.imports import check_permitted, foreign_module, look_here
from torchrl_her_recipes.config.recipe import Recipe

Player = Callable[[TensorDictBase], TensorDictBase]

_AT_ONCE = 20  # largest number of gymnasium environments in an evaluation: each takes 10 MB or more


def evaluation_envs(task: str, episodes: int) -> int:
    """Returns the number of environments that evaluate a run; with many episodes, each plays several.

    Example:
        >>> evaluation_envs("hand_v0", 45), evaluation_envs("gym:FetchPush-v4", 45)
        (45, 15)
    """
    rounds = math.ceil(episodes / _AT_ONCE) if task.startswith(GYM) else 1
    return math.ceil(episodes / rounds)


def play_episodes(env: EnvBase, policy: Player, episodes: int, *, runs: int = 1) -> TensorDictBase:
    """Plays greedy episodes of R runs, in several rounds if there are fewer environments than episodes.

    Args:
        env: R equal blocks of environments.
        policy: policy that acts in all environments.
        episodes: number of episodes of each run.

    Keyword Args:
        runs: R.

    Returns:
        The rollout [R * episodes, T], with the episodes of each run together.
    """
    worlds, max_steps = env.batch_size[0] // runs, goal_env(env).max_steps
    played = [evaluate(env, policy, max_steps=max_steps) for _ in range(math.ceil(episodes / worlds))]
    if len(played) == 1:
        return played[0]
    return torch.cat([batch.unflatten(0, (runs, worlds)) for batch in played], 1)[:, :episodes].flatten(0, 1)


@dataclass(frozen=True)
class TaskEnvs:
    """Makes all environments of a recipe, and imports or refuses the modules that its task names.

    Attributes:
        task: Task and its options.
        dtype: Name of the type of observations and rewards.
        gamma: Discount factor. The reward of a failure is the discounted return of never achieving the goal.
        curriculum: Options of the curriculum; None without a curriculum.
    """

    task: TaskConfig
    dtype: str
    gamma: Any
    curriculum: CurriculumConfig | None = None

    @classmethod
    def of(cls, recipe: Recipe) -> TaskEnvs:
        """Returns an object that makes the environments of a recipe."""
        curriculum = recipe.curriculum if recipe.hindsight.algorithm.curriculum else None
        return cls(recipe.task, recipe.run.dtype, recipe.learner.gamma, curriculum)

    def make(
        self, num_envs: int, seeds: Sequence[int], *, pictures: bool = False, scaled: bool = True
    ) -> EnvBase:
        """Makes environments of the full task: ``num_envs`` for each seed.

        Args:
            num_envs: Number of environments for each seed.
            seeds: Seeds of the environments.

        Keyword Args:
            pictures: Whether environments that can render pictures are made so that they do.
            scaled: True for learning: continuous actions are in the range -1 to 1, and ``task.failure``
                determines the reward of failures. False for the task's own actions and rewards, as exported
                policies and recorded demonstrations use them.
        """
        task = self.task
        if foreign_module(task.name):
            check_permitted(task.name)
            look_here()
        options: dict[str, Any] = dict(task.options or {})
        if task.threshold is not None:
            options["threshold"] = task.threshold
        if self.dtype != "float32":
            options["dtype"] = getattr(torch, self.dtype)
        if pictures:
            options = {**get_task_spec(task.name).for_pictures, **options}
        env = make_env(task.name, num_envs=num_envs * len(seeds), seed=seeds, **options)
        if not scaled:
            return env
        transforms: list[Transform] = []
        if "termination" in get_task_spec(task.name).options and task.failure != "environment":
            missed = reward_range(goal_env(env))[0]
            worth = missed / (1 - self.gamma) if task.failure == "never_pays" else None
            transforms.append(Failures(worth, EnvReward.of(env)))
        low, high = action_bounds(env)
        if not (low.eq(-1).all() and high.eq(1).all()):
            transforms.append(ActionScaling())
        return TransformedEnv(env, Compose(*transforms)) if transforms else env


def action_bounds(env: EnvBase) -> tuple[Tensor, Tensor]:
    """Returns a task's own bounds of actions, low and high [actions]; -1 and 1 if they are not finite.

    Transforms that scale actions do not change this result.
    """
    actions = goal_env(env).action_spec_unbatched
    if isinstance(actions, Bounded) and bool((actions.low.isfinite() & actions.high.isfinite()).all()):
        return actions.low, actions.high
    one = torch.ones(actions.shape, device=actions.device)
    return -one, one
