"""Recipes shrunk to seconds, and comparing what comes of them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pandas as pd
import torch
from tensordict import TensorDictBase

from torchrl_her import load_checkpoint
from torchrl_her_recipes import Components, Recipe, make_recipe
from torchrl_her_recipes.runs.interrupt import Interrupted

Refused = Callable[..., str]  # the fixture `refused`

SMALL: dict[str, Any] = {
    "epochs": 2,
    "epoch_frames": 480,
    "num_envs": 8,
    "frames_per_update": 20,
    "hidden": 64,
    "gamma": 0.98,
    "warmup_frames": 400,
    "batch_size": 32,
    "buffer_size": 20_000,
    "episodes": 4,
    "checkpoint_interval": 1,
    "pictures": False,  # they take longer than the training
    "log": [],  # resuming waits for the next second when it opens TensorBoard's file
    "keep_buffer": True,  # so that tests can compare it, and give finished runs more epochs
}


def small(**options: Any) -> Recipe:
    """A recipe that runs in about a second."""
    return make_recipe({**SMALL, "goal_sources": {"future": 3, "actual": 1}}, **options)


def stop_after(components: Components, batches: int) -> None:
    """Lets a run be interrupted when it asks for one batch more than so many."""
    collect, left = components.collector.next, iter(range(batches, -1, -1))

    def next_batch() -> TensorDictBase:
        if next(left) == 0:
            raise Interrupted
        return collect()

    components.collector.next = next_batch  # type: ignore[method-assign]


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


def assert_same_runs(first: Path, second: Path) -> None:
    """Two folders: all weights, buffers and generators, and the tables but for the time."""
    assert_same(*(load_checkpoint(folder / "checkpoint.pt") for folder in (first, second)))
    for name in ("policy.safetensors", "best.safetensors"):
        assert (first / name).read_bytes() == (second / name).read_bytes()
    tables = [pd.read_csv(folder / "metrics.csv").drop(columns="seconds") for folder in (first, second)]
    pd.testing.assert_frame_equal(*tables, check_exact=True)
