"""Searches shrunk to seconds, in processes that may be killed at any moment."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from unittest import mock

import pytest

from torchrl_her_recipes import Search, make_recipe
from torchrl_her_recipes.config.searches.spaces import Space
from torchrl_her_recipes.tuning import search as module
from torchrl_her_recipes.tuning.search import SearchResult, tune

from ..runs.killed import was_killed
from ..studies.here import Here

SPACE = {
    "learning_rate": {"kind": "log_float", "low": 1e-4, "high": 1e-2},
    "k": {"kind": "int", "low": 1, "high": 8},
    "hidden": {"kind": "choice", "values": [8, 16]},
}
RECIPE: dict[str, Any] = {
    "task": "bit_flip",
    "task.options": {"bits": 3},
    "num_runs": 2,
    "epochs": 3,
    "epoch_frames": 80,
    "num_envs": 8,
    "warmup_frames": 0,
    "frames_per_update": 10,
    "batch_size": 16,
    "buffer_size": 1_000,
    "episodes": 20,
    "compile": "never",
    "checkpoint_interval": 1,
    "pictures": False,
    "hidden": 16,
    "depth": 2,
}


def small_search(space: dict[str, Any] | None = None, *, sampler: Any = "tpe", **options: Any) -> Search:
    """A search whose trials take a tenth of a second."""
    pruner = options.pop("pruner", "median")
    own = Space(name="small", ranges=SPACE if space is None else space)
    return Search(recipe=make_recipe(RECIPE, **options), space=own, sampler=sampler, pruner=pruner)


def go_on(
    search: Search, folder: Path, trials: int | None, *, pictures: bool = False, **options: Any
) -> SearchResult:
    """Searches in this process, perhaps without the pictures of it."""
    with pytest.MonkeyPatch.context() as patch:
        if not pictures:
            patch.setattr(module, "write_pictures", mock.Mock())
        workers = options.pop("workers", None) or Here()
        return tune(search, folder, trials=trials, workers=workers, progress=False, **options)


def is_killed(search: Search, folder: Path, trials: int, *, after: float) -> bool:
    """Lets a process go on with a search; returns whether it was killed before it came to the end."""
    return was_killed(go_on, search, folder, trials, after=after)
