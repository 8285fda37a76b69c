"""Stable-Baselines3's DDPG with its HER, made of a recipe: the peer of the benchmarks."""

from __future__ import annotations

import gymnasium
import numpy as np
from peer_env import PeerEnv
from stable_baselines3 import DDPG, HerReplayBuffer
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv

from torchrl_her_envs import TASKS, get_task
from torchrl_her_envs.registry import GYM
from torchrl_her_recipes import Recipe


class SB3Env(PeerEnv):
    """The peer environment with the reward function that Stable-Baselines3 relabels with."""

    def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, _info: object) -> np.ndarray:
        gap = np.square(achieved - desired).sum(-1)
        return (gap < self._threshold2).astype(np.float32) - 1.0


def make_sb3(recipe: Recipe, *, gradient_steps: int | None = None, noise: float = 0.0) -> DDPG:
    """The same networks, batches, discount, target update and number of gradient steps.

    It keeps real rows only, relabels while it samples, and has no prioritized replay.

    Args:
        recipe: what to be like.
        gradient_steps: for a step of all worlds; as many whole ones as the recipe says if None.
        noise: standard deviation of what is added to actions.
    """

    def make() -> gymnasium.Env:
        if recipe.task.name in TASKS:
            return SB3Env(get_task(recipe.task.name))
        return gymnasium.make(recipe.task.name.removeprefix(GYM))

    worlds = DummyVecEnv([make] * recipe.collection.num_envs)
    actions = worlds.action_space.shape
    return DDPG(
        "MultiInputPolicy",
        worlds,
        replay_buffer_class=HerReplayBuffer,
        replay_buffer_kwargs={"n_sampled_goal": recipe.hindsight.k, "goal_selection_strategy": "future"},
        policy_kwargs={"net_arch": [recipe.learner.hidden] * 3},
        gamma=recipe.learner.gamma,
        tau=recipe.learner.tau,
        learning_rate=recipe.learner.learning_rate,
        buffer_size=recipe.replay.buffer_size // (recipe.hindsight.k + 1),
        batch_size=recipe.replay.batch_size,
        train_freq=(1, "step"),
        gradient_steps=gradient_steps
        or int(recipe.collection.num_envs / recipe.collection.frames_per_update),
        learning_starts=recipe.collection.warmup_frames,
        action_noise=NormalActionNoise(np.zeros(actions), np.full(actions, noise)) if noise else None,
        seed=recipe.run.seed,  # of its environments, too
        device="cpu",
    )
