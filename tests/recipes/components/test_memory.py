"""Sizes beyond the memory of the machine."""

from __future__ import annotations

import math

import pytest
import torch

from torchrl_her_recipes import build, make_recipe
from torchrl_her_recipes.components import memory

SMALL = {"task": "hand_v0", "num_envs": 2, "steps_per_batch": 2, "pictures": False}


def test_sizes_beyond_memory_are_refused_by_name() -> None:
    # 9 + 2 numbers and 3 flags before and after the action, 3 of the action, and a reward
    message = "buffer_size=1000000000000 needs 220000 GB for num_runs=2, 110 bytes for each transition, but"
    with pytest.raises(ValueError, match=message):
        build(make_recipe(**SMALL, buffer_size=10**12, num_runs=2))


def test_a_buffer_that_just_fits_is_made(monkeypatch: pytest.MonkeyPatch) -> None:
    recipe = make_recipe(**SMALL, buffer_size=1_000, batch_size=16)
    monkeypatch.setattr(memory, "memory_of", lambda device: 110_000.0)
    assert build(recipe).buffer.storage.max_size == 1_000
    monkeypatch.setattr(memory, "memory_of", lambda device: 109_999.0)
    with pytest.raises(ValueError, match="buffer_size=1000 needs 0 GB"):
        build(recipe)


def test_limits_that_limit_nothing_may_be_infinite() -> None:
    recipe = make_recipe(**SMALL, max_grad_norm=math.inf, normalize=True, normalize_clip=math.inf)
    assert build(recipe).recipe.learner.max_grad_norm == torch.inf
