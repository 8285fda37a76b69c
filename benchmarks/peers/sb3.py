"""DDPG and TD3 of Stable-Baselines3, with its HER."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from stable_baselines3 import DDPG, TD3
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from peers.baselines import Baseline, make_envs, options, steps_each
from torchrl_her_recipes import Recipe


class SB3DDPG(Baseline):
    """DDPG of Stable-Baselines3."""

    name: ClassVar[str] = "Stable-Baselines3, DDPG"
    differs: ClassVar[str] = (
        "no priorities, no clipping of gradients or targets; transitions are relabeled when they are drawn, "
        "once for each gradient step; its networks see the achieved goal, too."
    )
    algorithm: ClassVar[type[OffPolicyAlgorithm]] = DDPG


class SB3TD3(Baseline):
    """TD3 of Stable-Baselines3."""

    name: ClassVar[str] = "Stable-Baselines3, TD3"
    differs: ClassVar[str] = (
        "as its DDPG, with two critics and smoothed targets; the actor and all target networks move every "
        "second step."
    )
    algorithm: ClassVar[type[OffPolicyAlgorithm]] = TD3


def make_sb3(recipe: Recipe, *, noise: float = 0.0) -> DDPG:
    """Makes DDPG with the options and the number of environments of a recipe, to compare success.

    It stores real rows only, relabels while it samples, and has no prioritized replay.

    Args:
        recipe: recipe whose options the model gets.
        noise: standard deviation of the noise on actions.
    """
    envs = make_envs(recipe)
    actions = envs.action_space.shape
    return DDPG(
        env=envs,
        train_freq=(1, "step"),
        gradient_steps=steps_each(recipe),
        learning_starts=recipe.collection.warmup_frames,
        action_noise=NormalActionNoise(np.zeros(actions), np.full(actions, noise)) if noise else None,
        **options(recipe),
    )
