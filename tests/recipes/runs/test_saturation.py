"""A run whose actor is stuck at the bounds of its actions says so once, with what helps."""

from __future__ import annotations

import math
from pathlib import Path

import pandas as pd
import pytest
import torch

from torchrl_her_recipes import build, make_recipe, run
from torchrl_her_recipes.runs.saturation import saturation, saturation_notices

from ..small import small

Rows = list[dict[str, float]]


def table(saturations: list[float], success: float = 0.0, *, run: int = 0, **more: float) -> Rows:
    return [
        {"run": run, "seed": 5 + run, "epoch": epoch, "success": success, "saturation": share, **more}
        for epoch, share in enumerate(saturations, start=1)
    ]


def test_an_entry_counts_within_a_hundredth_of_half_the_range_of_its_bounds() -> None:
    low, high = torch.tensor([-1.0, 0.0]), torch.tensor([1.0, 4.0])
    action = torch.tensor([[0.0, 2.0], [0.991, 2.0], [-0.991, 3.99], [0.98, 0.0], [0.989, 3.97]])
    assert saturation(action, low, high).tolist() == [0.0, 0.5, 1.0, 0.5, 0.0]
    assert saturation(torch.full((1,), 1e9), torch.tensor([-math.inf]), torch.tensor([math.inf])) == 0.0


def test_it_is_said_after_three_epochs_in_a_row_and_never_again() -> None:
    shares = [0.99, 0.96, 0.5, 0.95, 0.97, 1.0, 1.0, 0.2, 1.0, 1.0, 1.0]
    said = [len(saturation_notices(table(shares[:epoch]), make_recipe())) for epoch in range(1, 12)]
    assert said == [0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0]


def test_full_speed_with_success_is_right() -> None:
    assert saturation_notices(table([1.0] * 3, success=0.5), make_recipe()) == []
    assert len(saturation_notices(table([1.0] * 3, success=0.49), make_recipe())) == 1


def test_in_a_curriculum_the_success_of_the_present_layer_counts() -> None:
    assert saturation_notices(table([1.0] * 3, layer_success=0.9), make_recipe()) == []
    assert "with 20% success" in saturation_notices(table([1.0] * 3, layer_success=0.2), make_recipe())[0]


def test_each_run_is_told_apart() -> None:
    rows = sorted(table([1.0] * 3) + table([0.9] * 3, run=1), key=lambda row: (row["epoch"], row["run"]))
    (line,) = saturation_notices(rows, make_recipe())
    assert line.startswith(
        "seed 5: nearly all greedy actions have been at their bounds for 3 epochs (now 100%)"
    )


@pytest.mark.parametrize(
    ("learner", "helps"),
    [
        ("ddpg", "action_penalty above 0.3, learning_rate below 0.001 or num_envs above 64"),
        ("td3", "action_penalty above 0.3, learning_rate below 0.001 or num_envs above 64"),
        ("sac", "action_penalty above 0.3, learning_rate below 0.001 or num_envs above 64"),
    ],
)
def test_what_helps_are_options_that_the_learner_has(learner: str, helps: str) -> None:
    (line,) = saturation_notices(table([1.0] * 3), make_recipe(learner=learner))
    assert line.endswith(f"What helps: {helps}")


def test_nothing_is_said_of_discrete_actions() -> None:
    rows = [{"run": 0, "seed": 0, "epoch": epoch, "success": 0.0} for epoch in range(1, 6)]
    assert saturation_notices(rows, make_recipe(learner="dqn", task="bit_flip")) == []


def test_a_run_says_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    components = build(small(epochs=4, learning_rate=0.5, action_penalty=0.0, compile="never"))
    run(components, tmp_path / "run")
    said = [line for line in capsys.readouterr().out.splitlines() if "at their bounds" in line]
    assert len(said) == 1
    assert "What helps: action_penalty above 0, learning_rate below 0.5 or num_envs above 8" in said[0]
    assert (pd.read_csv(tmp_path / "run" / "metrics.csv")["saturation"] >= 0.95).all()
