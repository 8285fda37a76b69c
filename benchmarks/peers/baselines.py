"""What Stable-Baselines3 and SBX, which is built upon it, have in common: environments, options, the loop."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium
import numpy as np
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv

from peers.env import PeerEnv
from torchrl_her_envs import TASKS, get_task
from torchrl_her_envs.registry import GYM
from torchrl_her_recipes import Recipe

NEVER = 1 << 60  # frames or episodes: more than any benchmark plays


class RelabelingEnv(PeerEnv):
    """The peer environment with the reward function that Stable-Baselines3 relabels with."""

    def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, _info: object) -> np.ndarray:
        gap = np.square(achieved - desired).sum(-1)
        return (gap < self._threshold2).astype(np.float32) - 1.0


def make_envs(recipe: Recipe) -> DummyVecEnv:
    """As many environments of the task as in the recipe, in the leanest ordinary form that there is of it."""

    def make() -> gymnasium.Env:
        if recipe.task.name in TASKS:
            return RelabelingEnv(get_task(recipe.task.name))
        return gymnasium.make(recipe.task.name.removeprefix(GYM))

    return DummyVecEnv([make] * recipe.collection.num_envs)


def options(recipe: Recipe) -> dict[str, Any]:
    """The recipe's networks, batches, discount, target updates and hindsight, as both libraries name them."""
    return {
        "policy": "MultiInputPolicy",
        "replay_buffer_class": HerReplayBuffer,
        "replay_buffer_kwargs": {"n_sampled_goal": recipe.hindsight.k, "goal_selection_strategy": "future"},
        "policy_kwargs": {"net_arch": [recipe.learner.hidden] * recipe.learner.depth},
        "gamma": recipe.learner.gamma,
        "tau": recipe.learner.tau,
        "learning_rate": recipe.learner.learning_rate,
        "buffer_size": recipe.replay.buffer_size // (recipe.hindsight.k + 1),  # real transitions only
        "batch_size": recipe.replay.batch_size,
        "seed": recipe.run.seed,  # of the environments, too
        "device": "cpu",
    }


def steps_each(recipe: Recipe) -> int:
    """Gradient steps for a step of all environments: whole ones, rounded down, and at least one."""
    return max(1, int(recipe.collection.num_envs / recipe.collection.frames_per_update))


def rounds(recipe: Recipe) -> dict[str, Any]:
    """The recipe's environment steps between two rounds of gradient steps, and gradient steps in a round.

    Raises:
        ValueError: the recipe's are not whole, as they must be here.
    """
    collection = recipe.collection
    steps = collection.num_envs * collection.steps_per_batch / collection.frames_per_update
    if steps != int(steps) or steps < 1:
        raise ValueError(f"there must be a whole number of gradient steps in a round, got {steps}")
    return {"train_freq": (collection.steps_per_batch, "step"), "gradient_steps": int(steps)}


class Baseline:
    """The peer's interface over a model of either library.

    Args:
        recipe: what to be like.
    """

    algorithm: ClassVar[type[OffPolicyAlgorithm]]

    def __init__(self, recipe: Recipe) -> None:
        self.model = self.algorithm(
            env=make_envs(recipe), learning_starts=NEVER, **options(recipe), **rounds(recipe)
        )

    @property
    def updates(self) -> int:
        return self.model._n_updates

    def fill(self, frames: int) -> None:
        self.loop(frames)
        self.model.learning_starts = 0

    def gradient_steps(self, steps: int) -> int:
        before = self.updates
        self.model.train(gradient_steps=steps, batch_size=self.model.batch_size)
        self.wait()
        return self.updates - before

    def loop(self, frames: int) -> int:
        before = self.model.num_timesteps
        self.model.learn(frames, reset_num_timesteps=False, log_interval=NEVER)
        self.wait()
        return self.model.num_timesteps - before

    def wait(self) -> None:
        """Until everything that was begun has been computed."""
