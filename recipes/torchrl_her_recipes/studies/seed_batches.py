"""Divides the seeds of a study's combination into batches, trained side by side, and reads their results."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import numpy as np

from torchrl_her_recipes.config.recipe import Recipe
from torchrl_her_recipes.runs.folder import RunFolder
from torchrl_her_recipes.runs.goal_map import GoalMap
from torchrl_her_recipes.studies.jobs import Job, read_progress

_ROWS = 1_280  # rows in a gradient step of all runs together, above which further runs save no time


class Batches:
    """Results of a combination's runs, which are in folders ``seeds_*``, one for each batch of seeds.

    Only finished batches are read. If no batch is finished, unfinished batches are read, up to the last epoch
    that all of them have reached.

    Args:
        paths: folders that contain such folders, or folders of single runs; they need not exist.

    Attributes:
        homes: folders of the batches that were begun, in the order of their seeds.
    """

    def __init__(self, *paths: Path) -> None:
        folders: list[RunFolder] = []
        for path in paths:
            single = (path / "config.yaml").exists()
            folders += [
                RunFolder(folder)
                for folder in ([path] if single else sorted(path.glob("seeds_*"), key=_seeds_of))
            ]
        self.homes = [home for home in folders if home.config.exists()]

    @cached_property
    def _done(self) -> list[RunFolder]:
        return [home for home in self.homes if home.is_done]

    @cached_property
    def shown(self) -> list[RunFolder]:
        """Folders that are read: finished batches or, if there are none, all batches with results."""
        return self._done or [home for home in self.homes if home.rows()]

    @property
    def is_done(self) -> bool:
        """Whether the runs in the folders that are read are finished."""
        return bool(self._done)

    @property
    def recipe(self) -> Recipe | None:
        """The recipe of all runs in the folders that are read, as one recipe; None if there are none.

        Raises:
            ValueError: a configuration cannot be read.
        """
        recipes = [home.recipe() for home in self.shown]
        return recipes[0].replace(num_runs=sum(r.run.num_runs for r in recipes)) if recipes else None

    @property
    def seconds(self) -> float:
        """Total seconds of training of all batches, each on one core."""
        return sum(read_progress(home.path).seconds for home in self.shown)

    def rows(self) -> list[dict[str, float]]:
        """Joins the tables of metrics, sorted by epoch and run; runs are numbered by their seeds."""
        tables = [home.rows() for home in self.shown]
        shared = min((table[-1]["epoch"] for table in tables), default=0)
        return number_runs([row for table in tables for row in table if row["epoch"] <= shared])

    def goal_map(self) -> GoalMap | None:
        """Reads the maps of virtual goals of all runs as one map; None if no run has written one."""
        maps = [GoalMap.load(home.goal_map) for home in self.shown if home.goal_map.is_file()]
        return GoalMap(np.concatenate([part.counts for part in maps]), maps[0].target) if maps else None


def number_runs(rows: Sequence[dict[str, float]]) -> list[dict[str, float]]:
    """Numbers the runs of a table of metrics by their seeds, and sorts its rows by epoch and run."""
    seeds = sorted({row["seed"] for row in rows})
    numbered = [{**row, "run": seeds.index(row["seed"])} for row in rows]
    return sorted(numbered, key=lambda row: (row["epoch"], row["run"]))


def plan_batches(label: str, recipe: Recipe, folder: Path) -> list[Job]:
    """Plans the jobs of one combination: one for each existing batch, and new batches for missing seeds."""
    home = folder / label
    if (home / "config.yaml").exists():
        raise ValueError(f"{home} is the folder of a single run; choose another folder for the study")
    begun = [_seeds_of(batch.path) for batch in Batches(home).homes]
    missing = sorted(set(recipe.seeds).difference(*begun))
    batches = [*begun, *share_out(missing, most=max(_ROWS // recipe.replay.batch_size, 1))]
    return [
        Job(
            label=f"{label}/{_name(seeds)}",
            recipe=recipe.replace(seed=seeds[0], num_runs=len(seeds)),
            folder=home / _name(seeds),
        )
        for seeds in batches
    ]


def _name(seeds: Sequence[int]) -> str:
    ends = dict.fromkeys((seeds[0], seeds[-1]))
    return f"seeds_{'-'.join(map(str, ends))}"


def _seeds_of(path: Path) -> list[int]:
    """Returns the seeds of a batch, from the name of its folder."""
    match = re.fullmatch(r"seeds_(\d+)(?:-(\d+))?", path.name)
    if match is None:
        raise ValueError(f"{path} must have the name of a batch, such as seeds_0-4")
    return list(range(int(match[1]), int(match[2] or match[1]) + 1))


def share_out(seeds: Sequence[int], *, most: int) -> list[list[int]]:
    """Divides seeds into batches of consecutive seeds, as few and of as equal sizes as possible.

    Args:
        seeds: seeds in rising order, possibly with gaps.
        most: largest number of seeds in a batch.

    Example:
        >>> share_out([0, 1, 2, 3, 4, 5, 9], most=5)
        [[0, 1, 2], [3, 4, 5], [9]]
    """
    ends = [place + 1 for place, (one, other) in enumerate(pairwise(seeds)) if other != one + 1]
    runs = (seeds[start:end] for start, end in pairwise([0, *ends, len(seeds)]) if start < end)
    return [part.tolist() for run in runs for part in np.array_split(run, -(-len(run) // most))]
