"""Runs whose episodes ask for goals that were achieved before, and runs whose episodes have stages."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch

from torchrl_her import Instructiveness
from torchrl_her.behavior import BehaviorGoals, DiscoverScore, GoalFactor, InverseDensity, ValueCutoff
from torchrl_her.curriculum import EpisodeStages, StageOutcomes, TeacherStudent
from torchrl_her.replay_buffers import rows_of_run
from torchrl_her_recipes import Components, Recipe, RunResult, build, make_recipe, resume, run
from torchrl_her_recipes.components.goals.behavior import scaled_cutoffs
from torchrl_her_recipes.runs.curriculum import move_on

from ..small import assert_same_runs, small, stop_after

PLAIN: dict[str, Any] = {"task": "hand_v0", "algo": "her", "behavior.goal_memory": 5_000}
STAGES: dict[str, Any] = {"task": "hand_v1", "algo": "cher_ibs", "normalize": True, "guided_share": 0.5}
WAYS: dict[str, dict[str, Any]] = {
    "uniform_achieved": {**PLAIN, "behavior": "uniform_achieved", "num_runs": 2},
    "ibs": {**PLAIN, "behavior": "ibs"},
    "mega": {**PLAIN, "behavior": "mega", "normalize": True},
    "discover": {**PLAIN, "behavior": "discover", "learner": "td3", "num_runs": 2},
    "all at once": {**STAGES, "order": "all_at_once"},
    "teacher": {**STAGES, "order": "teacher_student", "behavior": "mega", "behavior.goal_memory": 5_000},
    "every stage": {**STAGES, "order": "all_at_once", "every_stage": True, "task_share": 1.0},
}


def recipe(way: str, **options: Any) -> Recipe:
    return small(**{**WAYS[way], **options})


Whole = Callable[[str], tuple[Components, RunResult]]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Whole:
    """Trains each way once."""

    @cache
    def train(way: str) -> tuple[Components, RunResult]:
        components = build(recipe(way))
        return components, run(components, tmp_path_factory.mktemp("whole"), progress=False)

    return train


@pytest.mark.parametrize("way", WAYS)
def test_a_run_that_was_stopped_goes_on_as_if_it_had_not(way: str, whole: Whole, tmp_path: Path) -> None:
    folder = whole(way)[1].folder
    components = build(recipe(way))
    stop_after(components, 9)  # in the second epoch
    assert run(components, tmp_path, progress=False).interrupted
    assert not resume(tmp_path, progress=False).interrupted
    assert_same_runs(folder, tmp_path)


@pytest.mark.parametrize("way", ["ibs", "mega", "teacher"])
def test_runs_side_by_side_are_those_that_they_would_be_alone(way: str) -> None:
    options: dict[str, Any] = {"dtype": "float64", "frames_per_update": 40.0}
    both, alone = (build(recipe(way, **options, **own)) for own in ({"num_runs": 2}, {"seed": 1}))
    for components in (both, alone):
        run(components, progress=False)
    rows, single = rows_of_run(both.buffer, 1), rows_of_run(alone.buffer)
    assert len(rows) == len(single)
    for key in ("desired_goal", "action", ("next", "reward")):
        torch.testing.assert_close(rows[key], single[key], rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("way", ["uniform_achieved", "ibs", "mega", "discover"])
def test_goals_are_proposed_and_counted(way: str, whole: Whole) -> None:
    components, result = whole(way)
    behavior = components.behavior
    assert min(behavior.memory.sizes) > 0
    assert 0.0 <= result.rows[-1]["proposed_success"] <= 1.0
    stored = rows_of_run(components.buffer, 0)
    assert not {"proposed", "real_desired_goal", "achieved_goal"} & set(stored.keys())


@pytest.mark.parametrize(
    ("way", "factors"),
    [
        ("uniform_achieved", []),
        ("ibs", []),
        ("mega", [InverseDensity, ValueCutoff]),
        ("discover", [DiscoverScore]),
    ],
)
def test_each_way_has_its_factors(way: str, factors: list[type[GoalFactor]]) -> None:
    behavior = build(recipe(way)).behavior
    assert [type(own) for own in behavior.proposal.factors] == factors
    assert behavior.proposal.greedy == bool(factors)
    assert [type(own).__name__ for own in behavior.proposal.weights] == ["Instructiveness"] * (way == "ibs")


def test_a_single_critic_leaves_it_to_rare_goals_what_is_new() -> None:
    behavior = build(recipe("discover", learner="ddpg")).behavior
    assert [type(own) for own in behavior.proposal.factors] == [
        InverseDensity,
        DiscoverScore,
    ]  # TD3 above has two critics


def test_evaluation_asks_for_the_tasks_goals() -> None:
    components = build(recipe("mega"))
    assert not isinstance(getattr(components.eval_env, "transform", None), BehaviorGoals)
    stageed = build(recipe("teacher"))
    assert not any(isinstance(own, BehaviorGoals) for own in stageed.eval_env.transform)
    assert any(isinstance(own, BehaviorGoals) for own in stageed.env.transform)


def test_in_a_curriculum_goals_are_proposed_in_the_last_stage() -> None:
    components = build(small(task="hand_v1", algo="cher", behavior="uniform_achieved", num_runs=2))
    samples = torch.zeros(2, components.recipe.order.window)
    samples[1] = 1.0
    move_on(components, components.curriculum, samples, 0)
    components.collector.next()
    assert components.behavior.memory.sizes[0] == 0
    assert components.behavior.memory.sizes[1] > 0


def test_ibs_proposals_begin_with_the_last_stage() -> None:
    components = build(small(task="hand_v1", algo="cher", behavior="ibs"))
    (weights,) = components.behavior.proposal.weights
    assert isinstance(weights, Instructiveness)
    first = weights.sigma
    components.trainer().epoch()
    assert weights.sigma < first
    move_on(components, components.curriculum, torch.ones(1, components.recipe.order.window), 0)
    assert weights.sigma == first


# Episodes with stages of their own


def test_one_buffer_holds_rows_of_all_stages(whole: Whole) -> None:
    components, _ = whole("all at once")
    assert isinstance(components.curriculum.progress, EpisodeStages)
    rows = rows_of_run(components.buffer, 0)
    counts = rows["stage"].flatten().bincount(minlength=2)
    assert counts.min() > 0
    first = rows["stage"].squeeze(-1) == 0
    # The first stage sees the hand alone: its goal is not observed, nor is the ball's speed.
    assert (rows["observation"][first][:, 5:] == 0).all()
    assert (rows["observation"][~first][:, 5:7] != 0).any()


def test_the_full_task_alone_is_played_and_trains_every_stage(whole: Whole) -> None:
    components, _ = whole("every stage")
    rows = rows_of_run(components.buffer, 0)
    rows = rows[~rows["virtual"].squeeze(-1)]
    reach, throw = (rows[rows["stage"].squeeze(-1) == stage] for stage in (0, 1))
    assert torch.equal(reach["action"], throw["action"])
    assert torch.equal(reach["observation"][:, :5], throw["observation"][:, :5])
    assert (reach["observation"][:, 5:] == 0).all()
    assert torch.equal(reach["desired_goal"], throw["observation"][:, 5:7])  # the hand is to be at the ball


def test_a_teacher_knows_both_stages(whole: Whole) -> None:
    components, result = whole("teacher")
    teacher = components.curriculum.progress
    assert isinstance(teacher, TeacherStudent)
    assert isinstance(components.env.transform[-1], StageOutcomes)
    assert 0.0 < result.rows[-1]["mean_stage"] < 1.0
    assert "stage" not in result.rows[-1]


def test_the_policy_itself_begins_episodes() -> None:
    components = build(recipe("all at once", guided_share=1.0))
    assert components.guide.guide is components.actor
    batch = components.collector.next()
    top = batch["next", "stage"][:, -1] == 1
    assert ((components.guide.guided == 0) <= top).all()


def test_a_teacher_is_told_of_the_stages_own_goals(monkeypatch: pytest.MonkeyPatch) -> None:
    told = torch.zeros(2, dtype=torch.int64)

    def record(self: TeacherStudent, ended: torch.Tensor, achieved: torch.Tensor) -> None:
        told.add_(ended[0])

    monkeypatch.setattr(TeacherStudent, "record_episodes", record)
    components = build(recipe("teacher", guided_share=0.0))
    ended = torch.zeros_like(told)
    for _ in range(20):
        batch = components.collector.next()
        counts = batch["next", "done"] & ~batch["proposed"]
        ended += batch["stage"][counts].bincount(minlength=2)
    assert batch["proposed"].any()
    assert torch.equal(told, ended)


def test_the_cutoff_is_in_the_unit_of_the_tasks_values() -> None:
    behavior = build(recipe("mega", gamma=0.98)).behavior
    achievable = behavior.proposal.factors[1]
    assert isinstance(achievable, ValueCutoff)
    assert (achievable.first, achievable.floor, achievable.step) == pytest.approx((-3.0, -50.0, 1.0))
    assert scaled_cutoffs(-3.0, 0.98, (0.0, 1.0)) == pytest.approx(
        {"cutoff": 0.94, "floor": 0.0, "step": 0.02}  # gamma^d of a goal that is 3 steps' worth away
    )


# What cannot be


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"behavior.cutoff": -5.0}, "behavior=real has no option cutoff; behavior=mega has it"),
        ({"behavior": "ibs", "behavior.cutoff": -5.0}, "behavior=ibs has no option cutoff; behavior=mega"),
        ({"behavior": "mga"}, "behavior must be one of real, .*, discover, got 'mga'; did you mean mega"),
        ({"behavior": "mega", "behavior.real_share": 2.0}, "real_share must be at least 0 and at most 1"),
        ({"behavior": "mega", "behavior.cutoff": float("nan")}, "cutoff must be finite, got nan"),
        (
            {"algo": "cher", "order": "all_at_once", "window": 5},
            "order=all_at_once has no option window; order=threshold has it",
        ),
        (
            {"algo": "cher", "learner": "sac", "order": "all_at_once", "success_threshold": 0.5},
            "order=all_at_once has no option success_threshold; order=threshold has it",
        ),
        ({"algo": "cher", "relay": True}, "order=threshold has no option relay; order=all_at_once or t"),
        ({"behavior": "uniform_achieved", "candidates": 7}, "behavior=uniform_achieved has no option c"),
        ({"behavior": "mega", "real_share": 1.0, "candidates": 7}, "candidates=7 has no effect with real_sh"),
        ({"algo": "no_hindsight", "virtual_goals": True}, "virtual_goals=True has no effect with algo=no_h"),
        ({"behavior": "ibs", "estimator": "kernel", "behavior.cells": 5}, "cells=5 has no effect with esti"),
    ],
)
def test_options_that_cannot_be(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_recipe({"algo": "her"}, **options)


def test_the_options_of_ibs_arrive_at_proposals_alone() -> None:
    options = {"sigma": 0.1, "behavior.cells": 8, "behavior.recent": 77, "floor": 0.01}
    components = build(recipe("ibs", **options))
    (weights,) = components.behavior.proposal.weights
    assert isinstance(weights, Instructiveness)
    assert weights.final_sigma == pytest.approx(0.1 * 2.0)  # the screen is 2 wide
    assert (weights.grid.shape, weights.recent, weights.floor) == ((8, 8), 77, 0.01)
    assert components.buffer.writer.weights.grid.shape == (20, 20)


@pytest.mark.parametrize("options", [{"behavior": "mega"}, {"algo": "cher", "order": "teacher_student"}])
def test_processes_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="it needs processes=0, got processes=2"):
        build(small(**{"algo": "her", "task": "hand_v1", **options, "processes": 2}))


def test_a_memory_below_what_comes_at_once_is_refused() -> None:
    with pytest.raises(ValueError, match="goal_memory=7 must be at least num_envs=8"):
        build(recipe("mega", **{"behavior.goal_memory": 7}))


def test_weights_that_cannot_tell_stages_apart_are_refused() -> None:
    with pytest.raises(ValueError, match="weights=rare cannot be used with order=all_at_once"):
        build(small(task="hand_v1", algo="cher_rare", order="all_at_once"))


def test_instructive_goals_around_the_start_are_refused() -> None:
    with pytest.raises(ValueError, match="IBS must not be used on hand_reach"):
        build(small(task="hand_reach", algo="her", behavior="ibs"))
