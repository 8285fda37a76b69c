"""Agents of Stable-Baselines3 and SBX with HER and the options of the RL Zoo for the Fetch tasks.

The options are those of the Zoo's ``hyperparams/tqc.yml``, also for SAC, for which it has no current ones.
"""

from __future__ import annotations

from typing import Any

from sb3_contrib import TQC
from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from torchrl_her_envs.gym.check import make_one
from torchrl_her_envs.registry import GYM
from torchrl_her_recipes import Recipe

_BATCHES = {"gym:FetchPush-v4": 2048, "gym:FetchSlide-v4": 2048, "gym:FetchPickAndPlace-v4": 1024}


def make_zoo(algorithm: str, recipe: Recipe) -> OffPolicyAlgorithm:
    """Makes an agent for the task and the seed of a recipe.

    Args:
        algorithm: TQC or SAC of Stable-Baselines3, or SBX-TQC.
        recipe: recipe whose task and seed are used; other options have no effect.

    Raises:
        ValueError: the task is none of those whose options are known here.
    """
    if (name := recipe.task.name) not in _BATCHES:
        raise ValueError(f"the RL Zoo's options are known here for {', '.join(_BATCHES)}, not for {name}")
    options: dict[str, Any] = {
        "policy": "MultiInputPolicy",
        "env": make_one(name.removeprefix(GYM), None, {}),
        "batch_size": _BATCHES[name],
        "buffer_size": 1_000_000,
        "gamma": 0.95,
        "learning_rate": 1e-3,
        "tau": 0.05,
        "replay_buffer_class": HerReplayBuffer,
        "replay_buffer_kwargs": {"n_sampled_goal": 4, "goal_selection_strategy": "future"},
        "policy_kwargs": {"net_arch": [512, 512, 512], "n_critics": 2},
        "seed": recipe.run.seed,
    }
    if algorithm == "SBX-TQC":
        from sbx import TQC as SBXTQC  # noqa: PLC0415  # only those who ask for it wait for JAX

        return SBXTQC(**options)
    return {"TQC": TQC, "SAC": SAC}[algorithm](**options, device="cpu")
