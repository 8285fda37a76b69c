"""Recipes shrunk to seconds, and comparing what comes of them."""

from __future__ import annotations

from typing import Any

import torch

from torchrl_her_recipes import Recipe, make_recipe

SMALL: dict[str, Any] = {
    "epochs": 2,
    "epoch_frames": 1_600,
    "num_envs": 8,
    "warmup_frames": 400,
    "batch_size": 32,
    "buffer_size": 20_000,
    "episodes": 4,
    "checkpoint_interval": 1,
}


def small(**options: Any) -> Recipe:
    """A recipe that runs in about a second."""
    return make_recipe(SMALL, **options)


def overrides(**options: Any) -> list[str]:
    """The same for the command line."""
    return [f"{name}={value}" for name, value in {**SMALL, **options}.items()]


def assert_same(first: Any, second: Any, *, path: str = "") -> None:
    """Nested plain data and tensors, bit for bit."""
    assert type(first) is type(second), path
    if isinstance(first, dict):
        assert first.keys() == second.keys(), path
        for key in first:
            assert_same(first[key], second[key], path=f"{path}/{key}")
    elif isinstance(first, list | tuple):
        for index, pair in enumerate(zip(first, second, strict=True)):
            assert_same(*pair, path=f"{path}/{index}")
    elif isinstance(first, torch.Tensor):
        assert first.dtype == second.dtype, path
        assert torch.equal(first, second), path
    else:
        assert first == second, path
