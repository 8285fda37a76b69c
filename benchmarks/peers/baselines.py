"""Environments, options and training loop that Stable-Baselines3 and SBX, which builds on it, share."""

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

NEVER = 1 << 60  # number of frames or episodes that no benchmark reaches


class RelabelingEnv(PeerEnv):
    """The ordinary environment, with the reward function by which Stable-Baselines3 relabels."""

    def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, _info: object) -> np.ndarray:
        gap = np.square(achieved - desired).sum(-1)
        return (gap < self._threshold2).astype(np.float32) - 1.0


def make_envs(recipe: Recipe) -> DummyVecEnv:
    """Makes the recipe's number of environments of its task, in the form with the least overhead."""

    def make() -> gymnasium.Env:
        if recipe.task.name in TASKS:
            return RelabelingEnv(get_task(recipe.task.name))
        return gymnasium.make(recipe.task.name.removeprefix(GYM))

    return DummyVecEnv([make] * recipe.collection.num_envs)


def options(recipe: Recipe) -> dict[str, Any]:
    """Returns the recipe's networks, batches, discount, target updates and HER as both libraries' options."""
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
        "seed": recipe.run.seed,  # also seeds the environments
        "device": "cpu",
    }


def steps_each(recipe: Recipe) -> int:
    """Returns the number of gradient steps per step of all environments, rounded down, but at least 1."""
    return max(1, int(recipe.collection.num_envs / recipe.collection.frames_per_update))


def rounds(recipe: Recipe) -> dict[str, Any]:
    """Returns the environment steps between two rounds of gradient steps, and gradient steps in a round.

    Raises:
        ValueError: the recipe's gradient steps in a round are not a whole number.
    """
    collection = recipe.collection
    steps = collection.num_envs * collection.steps_per_batch / collection.frames_per_update
    if steps != int(steps) or steps < 1:
        raise ValueError(f"gradient steps in a round must be a whole number, got {steps}")
    return {"train_freq": (collection.steps_per_batch, "step"), "gradient_steps": int(steps)}


class Baseline:
    """Interface :class:`Peer` for a model of Stable-Baselines3 or SBX.

    Args:
        recipe: recipe whose options the model gets.
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
        """Waits until all computations that were started are done."""
