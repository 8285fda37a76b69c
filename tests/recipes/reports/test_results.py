"""What there is of a study, and what a run reached in the end."""

from __future__ import annotations

from pathlib import Path

from torchrl_her_recipes import Recipe, make_recipe
from torchrl_her_recipes.reports.results import _differences, read_combinations
from torchrl_her_recipes.runs.scores import at_the_end

from .small_study import STUDY, write_run


def test_a_run_s_number_at_the_end_is_the_mean_of_its_last_three_evaluations() -> None:
    rows = [{"run": run, "success": value + run} for value in (9.0, 0.0, 1.0, 5.0) for run in (1, 0)]
    assert at_the_end(rows, "success") == [2.0, 3.0]
    assert at_the_end(rows, "success", evaluations=1) == [5.0, 6.0]


def test_a_combination_says_how_far_it_is(tmp_path: Path) -> None:
    write_run(tmp_path, STUDY, "hand_v2_her", [0.0, 0.1, 0.3, 0.9])
    write_run(tmp_path, STUDY, "hand_v2_filtered_her", [0.5, 0.5])
    write_run(tmp_path, STUDY, "robot_v2_her", [0.5] * 4, epochs=2)
    cells = {cell.label: cell for cell in read_combinations(STUDY, tmp_path)}
    assert {label: cell.state for label, cell in cells.items()} == {
        "hand_v2_her": "at its end",
        "hand_v2_filtered_her": "at its end with 2 of 4 runs",
        "robot_v2_her": "at epoch 2 of 3",
        "robot_v2_filtered_her": "missing",
    }
    whole = cells["hand_v2_her"]
    assert (whole.task, whole.algorithm, whole.runs, whole.frames) == ("hand_v2", "her", 4, 3_000)
    assert dict(whole.options) == {"task": "hand_v2", "algo": "her"}
    assert whole.seconds == 180.0
    assert whole.goals.counts.shape == (4, 4, 4)
    assert cells["robot_v2_filtered_her"].goals is None


def test_another_choice_is_a_difference_without_its_own_defaults() -> None:
    assert _differences(make_recipe(learner="sac"), Recipe()) == [("learner.name", "sac", "auto")]
    ibs = _differences(make_recipe(algo="her_ibs", sigma=0.3), make_recipe(algo="her"))
    assert ibs == [("hindsight.algo", "her_ibs", "her"), ("weights.sigma", 0.3, None)]
