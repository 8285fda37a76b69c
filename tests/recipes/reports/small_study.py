"""The folders that a small study's runs leave behind, without training anything."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from torchrl_her_recipes.config.study import Study
from torchrl_her_recipes.runs.goal_map import GoalMap

TASKS, ALGORITHMS = ["hand_v2", "robot_v2"], ["her", "filtered_her"]
RECIPE: dict[str, Any] = {"epochs": 3, "epoch_frames": 1_000, "num_runs": 4}
SAID: dict[str, Any] = {
    "expect": {
        "success": ["filtered_her > her"],
        "kl": ["filtered_her < her"],
        "q_bias": ["filtered_her < her"],
    },
    "published": {
        "where": {"kl": "their table 3"},
        "numbers": {"kl": {"hand_v2": {"her": 2.0317, "filtered_her": 0.3436}}},
    },
}
STUDY = Study(name="bias", summary="small", recipe=RECIPE, vary={"task": TASKS, "algo": ALGORITHMS}, **SAID)


def write_run(
    folder: Path, study: Study, label: str, success: Sequence[float], *, epochs: int = 3, seed: int = 0
) -> None:
    """The folder that a batch of runs leaves behind, a constant success for each run."""
    recipe = dict(study.cells())[label]
    home = folder / label
    home.mkdir(parents=True)
    (home / "config.yaml").write_text(yaml.safe_dump(recipe.to_dict()))
    rows = [
        {
            "run": run,
            "seed": seed + run,
            "epoch": epoch,
            "frames": 1_000 * epoch,
            "seconds": 60.0 * epoch,
            "success": value,
            "distance": 1.0 - value,
            "kl": 2.0 if recipe.hindsight.algo == "her" else 0.5,
            "q": -10.0,
            "return": -30.0,
            "q_bias": 20.0,
            "rows_real_positive": 10 * epoch,
            "rows_virtual_positive": 100 * epoch,
            "rows_useful_virtual_positive": 50 * epoch,
        }
        for epoch in range(1, epochs + 1)
        for run, value in enumerate(success)
    ]
    with open(home / "metrics.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    GoalMap(np.ones((len(success), 4, 4)), np.full((4, 4), 1 / 16)).save(home / "goal_map.npz")
    (home / "policy.safetensors").touch()


def write_study(folder: Path) -> Path:
    """The study as a user's file."""
    path = folder / "bias.yaml"
    about = {"summary": "a <small> one", "recipe": RECIPE, "vary": STUDY.vary, **SAID}
    path.write_text(yaml.safe_dump(about, sort_keys=False))
    return path


def table(path: Path) -> list[dict[str, str]]:
    with open(path, newline="") as file:
        return list(csv.DictReader(file))
