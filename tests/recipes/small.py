"""Recipes shrunk to seconds."""

from __future__ import annotations

from typing import Any

from torchrl_her_recipes import Recipe

SMALL: dict[str, Any] = {
    "epochs": 2,
    "epoch_frames": 1_600,
    "num_envs": 8,
    "warmup_frames": 400,
    "batch_size": 32,
    "buffer_size": 20_000,
    "eval_episodes": 4,
    "checkpoint_interval": 1,
}


def small(**options: Any) -> Recipe:
    """A recipe that runs in about a second."""
    return Recipe(**{**SMALL, **options})


def overrides(**options: Any) -> list[str]:
    """The same for the command line."""
    return [f"{name}={value}" for name, value in {**SMALL, **options}.items()]
