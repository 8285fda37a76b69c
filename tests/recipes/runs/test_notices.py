"""A run says what goes wrong while it does: once, with what helps, and nothing where all is well."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import torch

from torchrl_her_recipes import build, make_recipe, run
from torchrl_her_recipes.runs import notices as notices_module
from torchrl_her_recipes.runs.notices import notices, saturation

from ..small import small

Rows = list[dict[str, float]]
SPARSE = (-1.0, 0.0)
ROWS = {"rows_real": 1, "rows_virtual": 2, "rows_relabeled": 0.5}  # for each frame
SOURCE = Path(notices_module.__file__).read_text()
PAGE = Path(__file__).parents[3] / "docs" / "not_learning.md"


def table(epochs: int, run: int = 0, **values: Any) -> Rows:
    """So many epochs of a run that is well, but for the values given: one, or one for each epoch."""
    well = {
        "success": 0.9,
        "saturation": 0.1,
        "q": -5.0,
        "rows_real_positive": 50.0,
        "rows_virtual_positive": 100.0,
    }
    rows = []
    for epoch in range(epochs):
        row = {"run": run, "seed": 5 + run, "epoch": epoch + 1, "frames": 100.0 * (epoch + 1)}
        row |= {name: factor * row["frames"] for name, factor in ROWS.items()}
        own = {
            name: value[epoch] if isinstance(value, list) else value
            for name, value in (well | values).items()
        }
        rows.append(row | own)
    return rows


def said(rows: Rows, bounds: tuple[float, float] = SPARSE, **options: Any) -> list[list[str]]:
    """The notices after each epoch."""
    recipe = make_recipe(**{"algo": "filtered_her", "gamma": 0.98, **options})
    epochs = int(max(row["epoch"] for row in rows))
    return [
        notices([row for row in rows if row["epoch"] <= epoch], recipe, bounds)
        for epoch in range(1, epochs + 1)
    ]


def only(rows: Rows, *, after: int, bounds: tuple[float, float] = SPARSE, **options: Any) -> str:
    """The single notice, which comes after some epoch and is not repeated."""
    every = said(rows, bounds, **options)
    assert [epoch for epoch, lines in enumerate(every, start=1) for _ in lines] == [after]
    return every[after - 1][0]


def test_an_entry_counts_within_a_hundredth_of_half_the_range_of_its_bounds() -> None:
    low, high = torch.tensor([-1.0, 0.0]), torch.tensor([1.0, 4.0])
    action = torch.tensor([[0.0, 2.0], [0.991, 2.0], [-0.991, 3.99], [0.98, 0.0], [0.989, 3.97]])
    assert saturation(action, low, high).tolist() == [0.0, 0.5, 1.0, 0.5, 0.0]
    assert saturation(torch.full((1,), 1e9), torch.tensor([-math.inf]), torch.tensor([math.inf])) == 0.0


@pytest.mark.parametrize("algo", ["no_hindsight", "her", "filtered_her", "her_ibs", "cher"])
def test_nothing_is_said_of_runs_that_are_well(algo: str) -> None:
    rising = [0.0, 0.0, 0.1, 0.3, 0.2, 0.5, 0.6, 0.4, 0.8, 0.9]  # no run rises evenly
    rows = table(10, success=rising) + table(10, run=1, success=rising)
    assert not any(said(rows, algo=algo))


def test_nothing_achieved() -> None:
    line = only(table(8, success=0.0, rows_real_positive=0.0), after=5)
    assert line.startswith("seed 5: no goal has been achieved in 500 environment steps. What helps: a curric")
    assert "`torchrl-her check task=hand_v0`" in line
    achieved_once = [0.0, 0.0, 0.0, 1.0, 1.0, 1.0]
    assert not any(said(table(6, success=0.0, rows_real_positive=achieved_once)))
    assert not any(said(table(6, success=[0.0] * 5 + [0.1], rows_real_positive=0.0))[5:])


def test_the_filter_leaves_nothing() -> None:
    nothing = table(5, success=0.0, rows_virtual_positive=0.0, rows_relabeled=[0.0, 0.0, 1.0, 1.0, 2.0])
    line = only(nothing, after=3)
    assert line.startswith("seed 5: the filter has left 1 of 300 transitions with goals of their own episode")
    assert not any(said(nothing, algo="no_hindsight"))
    assert not any(said([row | {"success": 0.5} for row in nothing]))  # it learns all the same
    enough = [3.0, 5.0, 7.0, 9.0, 11.0]  # more than 0.02 of the transitions
    some = table(5, success=0.0, rows_virtual_positive=0.0, rows_relabeled=enough)
    assert not any(said(some))


def test_virtual_goals_that_were_achieved_already() -> None:
    rows = table(5, success=0.0)
    rows = [row | {"rows_virtual_positive": 0.96 * row["rows_virtual"]} for row in rows]
    line = only(rows, after=3, algo="her")
    assert line.startswith("seed 5: 96% of the virtual goals were achieved before the action")
    rows = [row | {"rows_virtual_positive": 0.95 * row["rows_virtual"]} for row in rows]
    assert not any(said(rows, algo="her"))


def test_actions_at_their_bounds_for_three_epochs_in_a_row() -> None:
    shares = [0.99, 0.96, 0.5, 0.95, 0.97, 1.0, 1.0, 0.2, 1.0, 1.0, 1.0]
    line = only(table(11, success=0.1, saturation=shares), after=6)
    assert line == (
        "seed 5: nearly all greedy actions have been at their bounds for 3 epochs (now 100%), with 10% "
        "success; the actor may have stopped learning. What helps: saturation_penalty above 0.3 or "
        "learning_rate below 0.001 or a larger batch_size"
    )
    assert not any(said(table(3, success=0.5, saturation=1.0)))  # full speed is right
    assert "What helps: learning_rate" in only(table(3, success=0.1, saturation=1.0), after=3, learner="sac")


def test_in_a_curriculum_the_success_of_the_present_stage_counts() -> None:
    assert not any(said(table(3, success=0.0, saturation=1.0, stage_success=0.9)))
    assert "with 20% success" in only(table(3, success=0.0, saturation=1.0, stage_success=0.2), after=3)


@pytest.mark.parametrize(
    ("q", "bounds"), [(13.0, (-1.0, 0.0)), (-63.0, (-1.0, 0.0)), (63.0, (0.0, 1.0)), (math.nan, (0.0, 1.0))]
)
def test_values_that_no_return_can_have(q: float, bounds: tuple[float, float]) -> None:
    line = only(table(4, q=[0.0, q, q, q]), after=4, bounds=bounds)  # gamma=0.98: returns up to 50
    assert "the critic gives starts a mean value of " in line
    assert "but returns are between " in line
    assert "clamp_targets" not in line  # it is on already


def test_values_within_a_quarter_of_the_range_are_let_be() -> None:
    assert not any(said(table(4, q=12.0)))
    assert not any(said(table(4, q=1e9), bounds=(-math.inf, math.inf)))
    line = only(table(3, q=63.0), after=3, learner="sac")
    assert "What helps: clamp_targets=true or tau below" in line


def test_success_that_falls_after_it_rose() -> None:
    fallen = [0.1, 0.9, 0.9, 0.9, 0.8, 0.3, 0.2, 0.2, 0.1]
    line = only(table(9, success=fallen), after=7)  # 0.9, and a mean of 0.43
    assert line.startswith(
        "seed 5: success was 90% and has fallen to 43%; best.safetensors has the best policy."
    )
    assert not any(said(table(9, success=fallen, stage=[0, 0, 0, 0, 1, 1, 1, 1, 1])))  # a new stage


def test_runs_that_differ_for_five_epochs() -> None:
    rows = table(7, success=0.9) + table(7, run=1, success=0.3)
    line = only(rows, after=5)
    assert line.startswith("the runs have differed by more than half in success for 5 epochs")
    assert not any(said(table(7, success=0.9) + table(7, run=1, success=[0.3] * 4 + [0.5] * 3)))


def test_each_run_is_told_apart() -> None:
    rows = table(3, success=0.2, saturation=1.0) + table(3, run=1, success=0.2, saturation=0.9)
    assert only(rows, after=3).startswith("seed 5: nearly all")


def test_discrete_actions_are_never_at_their_bounds() -> None:
    rows = [{name: row[name] for name in row if name != "saturation"} for row in table(6, success=0.2)]
    assert not any(said(rows, learner="dqn", task="bit_flip"))


def test_a_run_says_that_its_actions_are_at_their_bounds(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = {"learning_rate": 0.5, "saturation_penalty": 0.0, "norm": "none", "normalize": False}
    components = build(small(epochs=4, gamma=0.98, compile="never", **options))
    run(components, tmp_path / "run")
    lines = [line for line in capsys.readouterr().out.splitlines() if "at their bounds" in line]
    assert len(lines) == 1
    assert "What helps: saturation_penalty above 0 or learning_rate below 0.5" in lines[0]
    assert (pd.read_csv(tmp_path / "run" / "metrics.csv")["saturation"] >= 0.95).all()


def test_a_run_that_is_too_short_to_learn_says_so() -> None:
    options = {"epochs": 3, "epoch_frames": 100, "warmup_frames": 400}
    line = only(table(3, updates=0), after=3, **options)
    assert "ends after 300 environment steps, before its first gradient step" in line
    assert not any(said(table(3, updates=[0, 0, 20]), **options))  # epochs are rounded up to whole batches


def test_a_run_says_that_its_critic_diverges(capsys: pytest.CaptureFixture[str]) -> None:
    wild = {"learner": "td3", "learning_rate": 10.0, "max_grad_norm": 1e9, "clamp_targets": False, "tau": 0.5}
    run(build(small(epochs=4, epoch_frames=800, hidden=8, norm="none", **wild)))
    assert sum("the critic diverges" in line for line in capsys.readouterr().out.splitlines()) == 1


def test_the_page_about_them_has_each_of_them() -> None:
    page = PAGE.read_text()
    for words in (
        "before its first gradient step",
        "no goal has been achieved",
        "the filter has left",
        "of the virtual goals were achieved before the action",
        "nearly all greedy actions have been at their bounds",
        "the critic diverges",
        "and has fallen",
        "the runs have differed by more than half",
    ):
        assert words in page
        assert words in SOURCE.replace('"\n            "', "")
