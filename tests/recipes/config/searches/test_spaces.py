"""Spaces of searches: those that come with the package, and how others are refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from torchrl_her_recipes import LEARNERS, Search, load_preset, load_space, make_recipe, space_for
from torchrl_her_recipes.config.groups import HindsightConfig
from torchrl_her_recipes.config.searches.spaces import Space, space_names
from torchrl_her_recipes.config.shipped import shipped_names


@pytest.mark.parametrize("learner", sorted(LEARNERS.keys() - {"auto"}))
def test_every_learner_has_a_space_that_its_recipes_take(learner: str) -> None:
    task = "bit_flip" if learner == "dqn" else "hand_v0"
    recipe = make_recipe(load_preset("throwing"), task=task, learner=learner)
    space = space_for(recipe)
    Search(recipe=recipe, space=space)
    assert space.name == learner
    assert {"learning_rate", "gamma", "k"} <= set(space.ranges)


@pytest.mark.parametrize("learner", sorted(LEARNERS.keys() - {"auto"}))
def test_the_defaults_of_every_learner_lie_in_its_space(learner: str) -> None:
    recipe = make_recipe(task="bit_flip" if learner == "dqn" else "hand_v0", learner=learner, gamma=0.96)
    space = space_for(recipe)
    values = space.values_of(recipe)
    assert space.inside(values) == values
    assert values.keys() <= space.ranges.keys()
    assert "k" not in values  # goals come from goal_sources


def test_there_are_no_other_spaces() -> None:
    assert set(space_names()) == LEARNERS.keys() - {"auto"}


@pytest.mark.parametrize("preset", shipped_names("preset"))
def test_every_preset_can_be_searched_around(preset: str) -> None:
    recipe = make_recipe(load_preset(preset))
    assert len(Search(recipe=recipe, space=space_for(recipe)).space.ranges) > 8


def test_the_space_of_the_learner_that_auto_stands_for_and_of_options_that_have_an_effect() -> None:
    assert space_for(make_recipe(task="bit_flip")).name == "dqn"
    assert space_for(make_recipe(task="hand_v0")).name == "ddpg"
    assert "k" not in space_for(make_recipe(algo="no_hindsight")).ranges


def test_k_and_strategy_replace_the_goal_sources_of_a_recipe() -> None:
    plain = {"k": {"kind": "int", "low": 1, "high": 8}}
    recipe = make_recipe(task="hand_v0", goal_sources={"future": 3, "actual": 2})
    assert Space(name="mine", ranges=plain).recipe(recipe, {"k": 7}).hindsight.sources == {"future": 7}
    assert make_recipe({"k": 7}).hindsight.sources == {"future": 7}  # a preset
    assert make_recipe({"k": 4}).hindsight.sources == {"future": 4}
    assert HindsightConfig(k=7).sources == {"future": 7}


def test_values_of_a_trial_that_have_no_effect_beside_others_are_left_out() -> None:
    plain = {
        "algo": {"kind": "choice", "values": ["her", "no_hindsight"]},
        "k": {"kind": "int", "low": 1, "high": 8},
    }
    space, base = Space(name="mine", ranges=plain), make_recipe(task="hand_v0")
    assert space.recipe(base, {"algo": "her", "k": 7}).hindsight.k == 7
    assert space.recipe(base, {"algo": "no_hindsight", "k": 7}).hindsight.algo == "no_hindsight"


def test_a_space_is_what_was_written(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    text = "learner.gamma: {kind: float, low: 9e-1, high: 0.99}\nhidden: {kind: log_int, low: 8, high: '64'}"
    path.write_text(text)
    assert load_space(str(path)).ranges == {
        "learner.gamma": {"kind": "float", "low": 0.9, "high": 0.99},
        "hidden": {"kind": "log_int", "low": 8, "high": 64},
    }
    assert load_space(str(path)).without({"gamma": 0.95}).ranges.keys() == {"hidden"}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "must hold options by name, got None"),
        ("[1, 2]", r"must hold options by name, got \[1, 2\]"),
        ("1: {kind: float}", "must hold options by name, got {1: "),
        ("{}", "has no options to vary"),
        ("a: [", "cannot be read: line 1: while parsing"),
        ("[" * 30_000, "cannot be read: it is nested more than 30 levels deep"),
        ("#" * 1_100_000, "cannot be read: it has more than 1,048,576 bytes"),
        ("a: &a [x, x]\nb: [*a, *a]", r"cannot be read: it has an alias \(\*name\); write the value in full"),
        (
            "!!python/object/apply:os.system ['touch it']",
            "cannot be read: line 1: could not determine a constructor",
        ),
        ("gama: {kind: float, low: 0, high: 1}", "no option 'gama'; did you mean gamma?"),
        ("gamma: 0.9", "gamma of a space must have a kind, as in .* got 0.9"),
        ("gamma: {kind: flaot, low: 0, high: 1}", "kind of gamma must be one of .* got 'flaot'"),
        ("gamma: {kind: [float], low: 0, high: 1}", r"kind of gamma must be one of .* got \['float'\]"),
        ("gamma: {kind: float, low: 0.9}", "gamma of kind float must have low and high, got {'kind'"),
        (
            "gamma: {kind: float, low: 0.9, hihg: 1}",
            "gamma of kind float must have low and high, got .*'hihg'",
        ),
        (
            "gamma: {kind: float, low: 0.99, high: 0.9}",
            "low of gamma must be below high, and both above .* got 0.99 and 0.9",
        ),
        ("gamma: {kind: float, low: 0.9, high: 0.9}", "low of gamma must be below high, .* got 0.9 and 0.9"),
        (
            "gamma: {kind: float, low: .nan, high: 1}",
            "and both above -1e.15 and below 1e.15, got nan and 1.0",
        ),
        (
            "gamma: {kind: float, low: 0.1, high: .inf}",
            "and both above -1e.15 and below 1e.15, got 0.1 and inf",
        ),
        ("gamma: {kind: float, low: much, high: 1}", "low of gamma must be a number, got 'much'"),
        ("gamma: {kind: float, low: true, high: 1}", "low of gamma must be a number, got True"),
        (
            "gamma: {kind: float, low: 2026-01-01, high: 1}",
            r"low of gamma must be a number, got datetime\.date",
        ),
        ("gamma: {kind: float, values: [1, 2]}", "gamma of kind float must have low and high, got"),
        ("gamma: {kind: log_float, low: 0, high: 1}", "and both above 0 and below 1e.15, got 0.0 and 1.0"),
        ("k: {kind: int, low: 1.5, high: 3}", "low of k must be a whole number, got 1.5"),
        (
            "k: {kind: choice, values: 3}",
            "values of k must be a list of 2 to 100 different numbers, .* got 3",
        ),
        ("k: {kind: choice, values: [3]}", r"values of k must be a list of 2 to 100 .* got \[3\]"),
        (
            "k: {kind: choice, values: [3, 3]}",
            r"values of k must be a list of 2 to 100 different .* got \[3, 3\]",
        ),
        ("k: {kind: choice, values: [3, [4]]}", r"numbers, texts, true or false, got \[3, \[4\]\]"),
        ("k: {kind: choice, low: 3, high: 4}", "k of kind choice must have values, got"),
        ("seed: {kind: int, low: 1, high: 8}", "seed must be the same in all trials of a search"),
        ("task: {kind: choice, values: [hand_v0, hand_v1]}", "task must be the same in all trials"),
        ("frames: {kind: int, low: 1000, high: 2000}", "frames must be the same in all trials"),
        (
            "gamma: {kind: float, low: 0.1, high: 0.9}\nlearner.gamma: {kind: float, low: 0.1, high: 0.9}",
            "two entries for gamma",
        ),
    ],
)
def test_what_is_no_space_is_refused_in_one_line(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(ValueError, match=message) as caught:
        load_space(str(path))
    assert len(str(caught.value)) < 500
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("gamma: {kind: float, low: 0.9, high: 1.5}", "does not fit: gamma must be above 0 and below 1"),
        ("norm: {kind: choice, values: [layer, big]}", "does not fit: norm must be one of none, layer"),
        ("quantiles: {kind: int, low: 10, high: 30}", "does not fit: learner=auto has no option quantiles"),
        ("window: {kind: int, low: 10, high: 30}", "does not fit: window=10 has no effect with"),
        ("hidden: {kind: float, low: 10.5, high: 64}", "does not fit: hidden must be a whole number"),
    ],
)
def test_what_the_recipe_does_not_take_is_refused(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        Search(recipe=make_recipe(task="hand_v0"), space=load_space(str(path)))


def test_samplers_and_spaces_that_do_not_go_together() -> None:
    recipe = make_recipe(task="hand_v0")
    space = Space(name="mine", ranges={"k": {"kind": "int", "low": 1, "high": 4}})
    with pytest.raises(ValueError, match="--sampler cmaes needs at least two numeric options"):
        Search(recipe=recipe, space=space, sampler="cmaes")
    steps = Space(
        name="mine",
        ranges={name: {"kind": "float", "low": 0.1, "high": 0.2} for name in ("tau", "action_noise")},
    )
    with pytest.raises(
        ValueError, match="cmaes needs a space that contains the recipe's values, but tau=0.05 lies"
    ):
        Search(recipe=recipe, space=steps, sampler="cmaes")
    with pytest.raises(ValueError, match="sampler must be one of tpe, random, cmaes, got 'grid'"):
        Search(recipe=recipe, space=space, sampler="grid")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="all options of the space mine are given"):
        space.without({"hindsight.k": 3})
