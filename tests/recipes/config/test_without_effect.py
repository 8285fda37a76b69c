"""Options without effect are refused when they are asked for, and dropped when they come from a preset."""

from __future__ import annotations

from typing import Any

import pytest

from torchrl_her_recipes import Recipe, make_recipe

SHOWN = {"demonstrations.file": "demos.pt", "demonstrations.episodes": 10}
STARTS = {"demonstrations.starts_share": 0.5}
IDLE: list[tuple[dict[str, Any], dict[str, Any]]] = [
    ({"algo": "no_hindsight"}, {"k": 8}),
    ({"algo": "no_hindsight"}, {"goal_sources": {"actual": 2}}),
    ({"algo": "no_hindsight"}, {"cells": 8}),
    ({"k": 0}, {"strategy": "final"}),
    ({"k": 0, "algo": "her_ibs"}, {"sigma": 0.3}),
    ({"algo": "her"}, {"redraw": False}),
    ({"k": 0}, {"redraw": False}),
    ({"algo": "her_ibs", "estimator": "kernel"}, {"cells": 8}),
    ({"algo": "filtered_her_rare", "k": 0}, {"sharpness": 2.0}),
    ({"algo": "her"}, {"window": 5}),
    ({"algo": "cher", "learner": "sac"}, {"stage_epsilon": 0.5}),
    ({"sampler": "uniform"}, {"priority_alpha": 0.5}),
    ({"sampler": "uniform"}, {"priority_beta": 0.5}),
    ({"hard_update_interval": 3}, {"tau": 0.5}),
    ({"uniform_share": 1.0}, {"action_noise": 0.3}),
    ({"epsilon_start": 0.0, "epsilon_end": 0.0}, {"action_noise": 0.3}),
    ({"epsilon_start": 0.0, "epsilon_end": 0.0}, {"uniform_share": 0.5}),
    ({"normalize": False}, {"normalize_clip": 3.0}),
    ({"normalize": False}, {"normalize_least_std": 0.1}),
    ({"processes": 0}, {"sync": False}),
    ({"compile": "never"}, {"matmul_dtype": "bfloat16"}),
    ({"dtype": "float64"}, {"matmul_dtype": "bfloat16"}),
    ({"hidden": 31}, {"matmul_dtype": "bfloat16"}),
    ({}, {"demonstrations.file": "demos.pt"}),
    ({}, {"demonstrations.share": 0.3}),
    ({**SHOWN, "demonstrations.share": 0.0, **STARTS}, {"demonstrations.bc_weight": 0.3}),
    ({**SHOWN, "demonstrations.bc_weight": 0.0}, {"demonstrations.q_filter": False}),
    (SHOWN, {"demonstrations.starts_width": 9}),
    ({**SHOWN, "processes": 2}, {"demonstrations.starts_share": 0.5}),
    ({**SHOWN, "task": "bit_flip", "learner": "dqn"}, {"demonstrations.q_filter": False}),
    ({"task": "bit_flip"}, {"threshold": 0.5}),
    ({"task": "chain"}, {"dtype": "float64"}),
    ({"task": "gym:FetchReach-v4"}, {"dtype": "float64"}),
]


@pytest.mark.parametrize(("options", "idle"), IDLE)
def test_what_has_no_effect_is_refused_by_name_and_dropped_from_a_preset(
    options: dict[str, Any], idle: dict[str, Any]
) -> None:
    (name,) = idle
    with pytest.raises(ValueError, match=f"^{name}=.* has no effect with .*: leave it out"):
        make_recipe(**options, **idle)
    assert make_recipe(idle, **options) == make_recipe(**options)


@pytest.mark.parametrize(
    "options",
    [
        {"algo": "her", "cells": 8},  # goals are counted
        {"algo": "her_ibs_sequential", "sigma": 0.3},
        {"algo": "her_ibs", "estimator": "kernel", "floor": 0.1},
        {"algo": "filtered_her_rare", "sharpness": 2.0, "memory": 50},
        {"algo": "cher_rnd", "sharpness": 2.0},
        {"algo": "cher", "stage_epsilon": 0.5},
        {"algo": "cher", "epsilon_start": 0.0, "epsilon_end": 0.0, "action_noise": 0.1},
        {"task": "hand_v0", "threshold": 0.5, "dtype": "float64"},
        {**SHOWN, **STARTS, "demonstrations.starts_width": 9, "demonstrations.share": 0.0},
        {**SHOWN, "processes": 2, "demonstrations.q_filter": False},
        {**SHOWN, "task": "bit_flip", "learner": "dqn", "demonstrations.share": 0.5},
    ],
)
def test_what_has_an_effect_is_kept(options: dict[str, Any]) -> None:
    recipe = make_recipe(**options)
    assert Recipe.from_dict(recipe.to_dict()) == recipe != make_recipe(task=recipe.task.name)


def test_goal_sources_take_the_place_of_k_and_strategy_and_the_other_way_round() -> None:
    mixed = {"future": 2, "actual": 2}
    base = make_recipe(k=8, strategy="final")
    recipe = base.replace(goal_sources=mixed)
    assert recipe == make_recipe(goal_sources=mixed)
    assert recipe.hindsight.sources == mixed
    assert recipe.replace(k=8) == make_recipe(k=8)
    assert recipe.replace(strategy="final").hindsight.sources == {"final": 4}
    assert recipe.replace(k=0).hindsight.sources == {}
    more = recipe.replace(**{"hindsight.goal_sources.actual": 6})
    assert more.hindsight.sources == {"future": 2, "actual": 6}
    assert Recipe.from_dict(recipe.to_dict()) == recipe
    for short, shown in (({"k": 4}, "k=4"), ({"k": 2, "strategy": "future"}, "k=2 and strategy=future")):
        with pytest.raises(ValueError, match=rf"^{shown} and goal_sources=\{{.*\}} say the same: give one"):
            make_recipe(goal_sources=mixed, **short)
    values = {"hindsight": {"k": 8, "goal_sources": mixed}}
    with pytest.raises(ValueError, match="k=8 has no effect with goal_sources: leave it out"):
        Recipe.from_dict(values)
    assert make_recipe(algo="her_ibs", goal_sources=mixed, sigma=0.3).changed()["weights"] == {"sigma": 0.3}


def test_options_of_another_task_do_not_come_along() -> None:
    base = make_recipe(**{"task": "bit_flip", "task.options": {"bits": 4, "max_steps": 9}})
    assert base.replace(task="treasure_hunt").task.options == {"max_steps": 9}
    assert base.replace(task="hand_v0").task.options is None
