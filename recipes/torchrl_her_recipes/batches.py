"""The runs of one combination of a study: its seeds, in batches that are run side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from torchrl_her_recipes.goal_map import GoalMap
from torchrl_her_recipes.jobs import Job, read_progress
from torchrl_her_recipes.recipe import Recipe
from torchrl_her_recipes.run_folder import RunFolder

_ROWS = (
    1_280  # of the gradient step of a batch: more runs side by side are no faster, and fill no second core
)


class Batches:
    """What a folder holds of one combination.

    A batched run in the folder itself counts, and so do those in its folders ``seeds_*``.

    Args:
        path: of the folder; there may be none yet.

    Attributes:
        homes: folders of the runs that were begun, in the order of their seeds.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        found = [RunFolder(folder) for folder in (path, *path.glob("seeds_*"))]
        begun = [home for home in found if home.config.exists()]
        self.homes = sorted(begun, key=lambda home: home.recipe().seed)

    @property
    def recipe(self) -> Recipe | None:
        """What was run, with all seeds together; None if nothing was.

        Raises:
            ValueError: a configuration cannot be read.
        """
        recipes = [home.recipe() for home in self.homes]
        return replace(recipes[0], num_runs=sum(own.num_runs for own in recipes)) if recipes else None

    @property
    def is_done(self) -> bool:
        """Whether all that was begun has come to its end."""
        return bool(self.homes) and all(home.is_done for home in self.homes)

    @property
    def seconds(self) -> float:
        """How long all runs together took, their evaluations included and their pictures not."""
        return sum(read_progress(home.path).seconds for home in self.homes)

    def rows(self) -> list[dict[str, float]]:
        """The tables of all runs as one, up to the last epoch that all of them have reached.

        One row an epoch and run, in this order; runs are counted in the order of their seeds.
        """
        tables = [table for table in (home.rows() for home in self.homes) if table]
        if not tables:
            return []
        seeds = sorted({row["seed"] for table in tables for row in table})
        shared = min(table[-1]["epoch"] for table in tables)
        rows = [
            {**row, "run": seeds.index(row["seed"])}
            for table in tables
            for row in table
            if row["epoch"] <= shared
        ]
        return sorted(rows, key=lambda row: (row["epoch"], row["run"]))

    def goal_map(self) -> GoalMap | None:
        """Where the virtual goals of all runs lie; None where no run has written its map."""
        maps = [GoalMap.load(home.goal_map) for home in self.homes if home.goal_map.is_file()]
        return GoalMap(np.concatenate([own.counts for own in maps]), maps[0].target) if maps else None


def plan_batches(label: str, recipe: Recipe, folder: Path) -> list[Job]:
    """The jobs of one combination: the batches that there are, and those of the seeds that are missing.

    Args:
        label: of the combination.
        recipe: of all its seeds together.
        folder: of the study.

    Raises:
        ValueError: the folder has a run of other options under the same name.
    """
    jobs = []
    for home in Batches(folder / label).homes:
        own = home.recipe()
        if replace(own, seed=recipe.seed, num_runs=recipe.num_runs) != recipe:
            raise ValueError(f"{home.path} holds a run with other options; choose another folder")
        jobs.append(Job(label=home.path.relative_to(folder).as_posix(), recipe=own, folder=home.path))
    there = {seed for job in jobs for seed in job.recipe.seeds}
    missing = [seed for seed in recipe.seeds if seed not in there]
    for seeds in share_out(missing, most=max(_ROWS // recipe.batch_size, 1)):
        own = replace(recipe, seed=seeds[0], num_runs=len(seeds))
        name = f"{label}/seeds_{'-'.join(dict.fromkeys(map(str, (seeds[0], seeds[-1]))))}"
        jobs.append(Job(label=name, recipe=own, folder=folder / name))
    return jobs


def share_out(seeds: Sequence[int], *, most: int) -> list[list[int]]:
    """Neighbouring seeds in batches, as few and as equal as can be.

    Args:
        seeds: in rising order, not all of them neighbours.
        most: seeds of a batch.

    Example:
        >>> share_out([0, 1, 2, 3, 4, 5, 9], most=5)
        [[0, 1, 2], [3, 4, 5], [9]]
    """
    ends = [place + 1 for place, (one, other) in enumerate(pairwise(seeds)) if other != one + 1]
    runs = (seeds[start:end] for start, end in pairwise([0, *ends, len(seeds)]) if start < end)
    return [part.tolist() for run in runs for part in np.array_split(run, -(-len(run) // most))]
