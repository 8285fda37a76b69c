"""Seeds in batches: how they are shared out, that more are added to what is there, and read as one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchrl_her_recipes import Recipe, make_recipe
from torchrl_her_recipes.runs.folder import RunFolder
from torchrl_her_recipes.runs.goal_map import GoalMap
from torchrl_her_recipes.studies.plan import Plan
from torchrl_her_recipes.studies.seed_batches import Batches, plan_batches, share_out

FIVE = make_recipe(algo="her", num_runs=5, epochs=2)


def leave(path: Path, recipe: Recipe, *, epochs: int) -> None:
    """What a run leaves behind; its success is its seed, its goals are in a cell of its own."""
    home = RunFolder(path)
    home.create()
    home.describe(recipe)
    rows = [
        {"run": run, "seed": seed, "epoch": epoch, "frames": 100 * epoch, "success": float(seed)}
        for epoch in range(1, epochs + 1)
        for run, seed in enumerate(recipe.seeds)
    ]
    home.write_table(rows)
    counts = np.stack([np.eye(4)[seed % 4].reshape(2, 2) for seed in recipe.seeds])
    GoalMap(counts, np.full((2, 2), 0.25)).save(home.goal_map)
    home.policy.touch()


@given(seeds=st.sets(st.integers(0, 60)).map(sorted), most=st.integers(1, 12))
def test_seeds_are_shared_out_once_each_among_neighbours_and_evenly(seeds: list[int], most: int) -> None:
    components = share_out(seeds, most=most)
    assert [seed for part in components for seed in part] == seeds
    assert all(part == list(range(part[0], part[-1] + 1)) and len(part) <= most for part in components)
    if seeds and seeds[-1] - seeds[0] == len(seeds) - 1:
        assert len(components) == -(-len(seeds) // most)
        assert max(map(len, components)) - min(map(len, components)) <= 1


def test_more_seeds_are_added_to_those_that_there_are(tmp_path: Path) -> None:
    (job,) = plan_batches("her", FIVE, tmp_path)
    assert job.folder == tmp_path / "her" / "seeds_0-4"
    assert job.recipe == FIVE
    leave(job.folder, job.recipe, epochs=2)
    old, new, last = plan_batches("her", FIVE.replace(num_runs=12), tmp_path)
    assert old == job
    assert (new.label, new.recipe.seeds) == ("her/seeds_5-8", [5, 6, 7, 8])
    assert (last.label, last.recipe.seeds) == ("her/seeds_9-11", [9, 10, 11])
    assert plan_batches("her", FIVE.replace(num_runs=2), tmp_path) == [job]  # nothing is thrown away


def test_wide_batches_are_split_and_narrow_ones_are_not(tmp_path: Path) -> None:
    many = FIVE.replace(num_runs=15)
    assert [job.recipe.run.num_runs for job in plan_batches("her", many, tmp_path)] == [5, 5, 5]
    assert len(plan_batches("her", many.replace(batch_size=64), tmp_path)) == 1
    assert len(plan_batches("her", many.replace(batch_size=5_000), tmp_path)) == 15


def test_other_options_are_refused_whatever_the_seeds(tmp_path: Path) -> None:
    leave(tmp_path / "her" / "seeds_0-4", FIVE.replace(k=2), epochs=2)
    with pytest.raises(ValueError, match=r"her.seeds_0-4 holds a run with other options"):
        Plan(plan_batches("her", FIVE.replace(num_runs=10), tmp_path))


def test_batches_are_read_as_one_in_the_order_of_their_seeds(tmp_path: Path) -> None:
    leave(tmp_path / "seeds_10-11", FIVE.replace(seed=10, num_runs=2), epochs=1)
    leave(tmp_path / "seeds_5-9", FIVE.replace(seed=5), epochs=2)
    leave(tmp_path / "seeds_0-4", FIVE, epochs=1)
    for name in ("seeds_0-4", "seeds_5-9", "seeds_10-11"):
        RunFolder(tmp_path / name).policy.unlink()
    batches = Batches(tmp_path)
    assert batches.recipe == FIVE.replace(num_runs=12)
    assert not batches.is_done
    rows = batches.rows()  # of the one epoch that all have reached
    assert [row["run"] for row in rows] == [row["seed"] for row in rows] == list(range(12))
    assert {row["epoch"] for row in rows} == {1}
    goals = batches.goal_map()
    assert goals.counts.shape == (12, 2, 2)
    np.testing.assert_array_equal(goals.share, [[0.25, 0.25], [0.25, 0.25]])


def test_what_is_done_is_read_without_what_is_under_way(tmp_path: Path) -> None:
    leave(tmp_path / "seeds_0-4", FIVE, epochs=2)
    leave(tmp_path / "seeds_5-9", FIVE.replace(seed=5), epochs=1)
    batches = Batches(tmp_path)
    assert batches.is_done
    assert batches.recipe == FIVE
    assert {row["epoch"] for row in batches.rows()} == {1, 2}
    assert len(batches.rows()) == 10
    assert len(batches.homes) == 2


def test_a_run_of_train_is_read_but_a_study_does_not_count_it(tmp_path: Path) -> None:
    leave(tmp_path / "her", FIVE, epochs=2)
    assert Batches(tmp_path / "her").is_done
    with pytest.raises(ValueError, match="her is the folder of a single run; choose another folder"):
        plan_batches("her", FIVE.replace(num_runs=10), tmp_path)


def test_a_batch_whose_configuration_is_torn_is_as_planned(tmp_path: Path) -> None:
    leave(tmp_path / "her" / "seeds_0-4", FIVE, epochs=2)
    home = RunFolder(tmp_path / "her" / "seeds_0-4")
    home.config.write_text("")
    home.policy.unlink()
    (job,) = Plan(plan_batches("her", FIVE, tmp_path)).jobs
    assert job.recipe == FIVE


def test_nothing_begun_is_nothing_to_show(tmp_path: Path) -> None:
    batches = Batches(tmp_path / "her")
    assert (batches.recipe, batches.is_done, batches.rows(), batches.goal_map()) == (None, False, [], None)
