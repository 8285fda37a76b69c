"""Plans: what is left to do, and how long it will take."""

from __future__ import annotations

from pathlib import Path

import pytest

from torchrl_her_recipes.runs.folder import RunFolder
from torchrl_her_recipes.studies.jobs import Job, Progress
from torchrl_her_recipes.studies.plan import Plan, duration, relative_cost, wall_clock

from ..small import small


def jobs(folder: Path) -> list[Job]:
    short = small(epochs=10, epoch_frames=1_600)
    recipes = {"short": short, "long": short.replace(num_runs=4)}
    return [Job(label=label, recipe=recipe, folder=folder / label) for label, recipe in recipes.items()]


def write(folder: Path, *, epochs: int, seconds: float, checkpoint: bool) -> None:
    folder.mkdir()
    rows = "".join(f"{run},{run},{epochs},{100 * epochs},{seconds}\n" for run in range(2))
    (folder / "metrics.csv").write_text(f"run,seed,epoch,frames,seconds\n{rows}")
    if checkpoint:
        (folder / "checkpoint.pt").touch()


def test_what_is_done_is_left_out_and_the_longest_comes_first(tmp_path: Path) -> None:
    plan = Plan(jobs(tmp_path))
    assert [job.label for job in plan.to_go] == ["long", "short"]
    assert plan.steps == plan.steps_to_go(plan.jobs) == 5 * 16_000
    write(tmp_path / "long", epochs=10, seconds=30.0, checkpoint=False)
    RunFolder(tmp_path / "long").describe(plan.jobs[1].recipe)
    RunFolder(tmp_path / "long").policy.touch()
    plan = Plan(jobs(tmp_path))
    assert [job.label for job in plan.to_go] == ["short"]
    assert plan.steps_to_go(plan.jobs) == 16_000
    assert [line.split()[:2] for line in plan.table(2)[:2]] == [["short", "to"], ["long", "done"]]
    assert plan.table(2)[2].endswith(", 1 at once")


def test_only_what_a_run_can_go_on_from_counts(tmp_path: Path) -> None:
    write(tmp_path / "short", epochs=4, seconds=4.0, checkpoint=False)
    write(tmp_path / "long", epochs=5, seconds=4.0, checkpoint=True)
    RunFolder(tmp_path / "long").describe(jobs(tmp_path)[1].recipe)
    plan = Plan(jobs(tmp_path))
    assert plan.progress == {"short": Progress(), "long": Progress(5, 4.0)}
    assert "at epoch 5 of 10" in plan.table(2)[1]
    assert "32,000 steps to go" in plan.table(2)[1]


def test_times_are_those_of_the_study_s_own_epochs(tmp_path: Path) -> None:
    plan = Plan(jobs(tmp_path))
    assert plan.table(2)[1:] == ["  long   to do                     64,000 steps to go", "2 at once"]
    plan.progress["long"] = Progress(5, 40.0)  # 8 s an epoch of four runs, so 2 s one of a single run
    assert plan.wall_clock(plan.jobs, 1) == pytest.approx(40 + 20)
    assert plan.wall_clock(plan.jobs, 2) == pytest.approx(40)
    assert plan.table(2)[1:] == [
        "  long   at epoch 5 of 10          32,000 steps to go, about 40 s",
        "about 40 s, 2 at once",
    ]


def test_what_costs_more_takes_longer() -> None:
    one = relative_cost(small(), 10)
    assert relative_cost(small(), 20) == pytest.approx(2 * one)
    for more in (
        {"num_runs": 2},
        {"frames_per_update": 5},
        {"hidden": 256},
        {"depth": 4},
        {"batch_size": 256},
    ):
        assert relative_cost(small(**more), 10) > one


@pytest.mark.parametrize(
    ("seconds", "at_once", "until"),
    [([], 2, 0.0), ([5.0], 8, 5.0), ([4.0, 3.0, 2.0, 1.0], 2, 5.0), ([1.0, 2.0], 1, 3.0), ([1.0], 0, 1.0)],
)
def test_the_clock_on_the_wall(seconds: list[float], at_once: int, until: float) -> None:
    assert wall_clock(seconds, at_once) == until


def test_durations_are_for_people() -> None:
    assert [duration(seconds) for seconds in (0.2, 99, 100, 59 * 60, 3_600, 90_000)] == [
        "0 s",
        "99 s",
        "2 min",
        "59 min",
        "1 h 0 min",
        "25 h 0 min",
    ]
