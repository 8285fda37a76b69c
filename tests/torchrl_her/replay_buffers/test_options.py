"""The options that the writer and the sample unit share."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator
from dataclasses import FrozenInstanceError, fields, replace
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from torchrl_her import (
    EnvKeys,
    EnvReward,
    GoalReward,
    GoalWeights,
    HERSampleUnit,
    HERWriter,
    HindsightOptions,
    register_strategy,
)
from torchrl_her.goals import STRATEGIES

from ..her_data import make_batch, tag

REWARD = GoalReward(0.5)  # tags differ by at least 1
OTHERS = {
    "k": 2,
    "strategy": "episode",
    "goal_sources": None,
    "recent_actual": 7,
    "recent_achieved": 70,
    "per": "episode",
    "n_steps": 1,
    "gamma": 0.9,
    "filter_achieved": True,
    "redraw": False,
    "exclude": ("state", "action"),
    "keys": EnvKeys(achieved_goal=("goals", "got"), reward="cost"),
    "trajectory_key": "path",
    "env_ids_key": "who",
    "real_goal_key": ("goals", "real"),
    "stage_key": "phase",
    "virtual_key": None,
}

both = pytest.mark.parametrize("make", [HERWriter, HERSampleUnit])


def relabeled(make: Callable[..., Any], *args: Any, reward: Any = REWARD, **options: Any) -> TensorDict:
    """Ten episodes of four steps: as they are stored by a writer, or a sample of them by a unit."""
    part = make(reward, *args, **options)
    parts = {"writer": part} if make is HERWriter else {"sample_unit": part, "collate_fn": part.relabel}
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(1_000), batch_size=2_000, **parts)
    buffer.set_rng(torch.Generator().manual_seed(3))
    batch = make_batch([[4] * 10]).squeeze(0)
    after = batch["next"]
    after["reward"] = reward(after["achieved_goal"], after["desired_goal"])[0].view_as(after["reward"])
    buffer.extend(batch)
    return buffer[:] if make is HERWriter else buffer.sample()


def lent(transitions: TensorDict) -> set[tuple[float, float]]:
    """(step, step that achieved the goal) of all virtual transitions of the first episode."""
    own = transitions[transitions["virtual"].squeeze(-1)]
    pairs = zip(own["achieved_goal"][:, 0].tolist(), own["desired_goal"][:, 0].tolist(), strict=True)
    return {(before, goal - 1) for before, goal in pairs if before < tag(0, 1, 0)}


def test_every_option_has_another_value_in_these_tests() -> None:
    defaults = HindsightOptions()
    assert [field.name for field in fields(defaults)] == list(OTHERS)
    alike = [name for name, value in OTHERS.items() if getattr(defaults, name) == value]
    assert alike == ["goal_sources", "n_steps"]  # which exclude k and strategy, and whole episodes


@both
def test_writer_and_unit_take_the_same_options(make: Callable[..., Any]) -> None:
    as_object = make(REWARD, HindsightOptions(**OTHERS))
    as_keywords = make(REWARD, **OTHERS)
    changed = make(REWARD, HindsightOptions(k=9, strategy="final"), **OTHERS)
    assert as_object.options == as_keywords.options == changed.options == HindsightOptions(**OTHERS)
    assert make(REWARD).options == HindsightOptions()
    assert as_object.reward_fn is REWARD


@both
def test_relabeling_needs_the_flag_of_the_time_limit(make: Callable[..., Any]) -> None:
    with pytest.raises(ValueError, match="needs a key for truncated, got keys.truncated=None"):
        make(REWARD, keys=EnvKeys(truncated=None))


@both
def test_options_are_read_and_set_as_attributes(make: Callable[..., Any]) -> None:
    part = make(REWARD, k=2)
    part.k, part.strategy, part.filter_achieved = 7, "final", True
    assert part.options == HindsightOptions(k=7, strategy="final", filter_achieved=True)
    assert (part.k, part.strategy, part.filter_achieved) == (7, "final", True)
    for name, value, message in (("k", -1, "k must be at least 0, got -1"), ("strategy", "past", "'past'")):
        with pytest.raises(ValueError, match=message):
            setattr(part, name, value)
    assert (part.k, part.strategy) == (7, "final")
    part.options = replace(part.options, keys=EnvKeys(reward="cost"), exclude=("seen",), real_goal_key="real")
    assert part._keys.reward == ("next", "cost")
    assert part._exclude == ["seen", ("next", "seen"), "real", ("next", "real")]


@both
def test_every_option_can_be_set_as_an_attribute(make: Callable[..., Any]) -> None:
    part = make(REWARD)
    for name, value in OTHERS.items():
        setattr(part, name, value)
    assert part.options == HindsightOptions(**OTHERS)
    assert {name: getattr(part, name) for name in OTHERS} == OTHERS


@both
@pytest.mark.parametrize(("lost", "won"), [(0.0, 1.0), (-2.0, -1.0)])
def test_a_reward_function_says_which_reward_an_achieved_goal_has(
    make: Callable[..., Any], lost: float, won: float
) -> None:
    rule = GoalReward(0.5, missed_reward=lost, achieved_reward=won)
    wrapped = EnvReward(lambda *goals: rule(*goals)[0], lambda *goals: rule(*goals)[1], achieved_reward=won)
    rows, same, usual = (relabeled(make, filter_achieved=True, reward=of) for of in (rule, wrapped, REWARD))
    assert torch.equal(rows["virtual"], usual["virtual"])
    assert torch.equal(rows["next", "reward"] == won, usual["next", "reward"] == 0.0)
    assert (same == rows).all()


@both
def test_a_reward_of_equal_goals_that_does_not_count_as_achieved_is_named(make: Callable[..., Any]) -> None:
    rule = GoalReward(0.5, missed_reward=0.0, achieved_reward=1.0)
    with pytest.warns(UserWarning, match=r"equal goals have 1; give the reward .* achieved_reward=1\)"):
        relabeled(make, reward=EnvReward(lambda *goals: rule(*goals)[0]))
    relabeled(make, reward=EnvReward(lambda *goals: rule(*goals)[0], achieved_reward=1.0))


@both
def test_the_observation_is_stored_whatever_its_name(make: Callable[..., Any]) -> None:
    assert make(REWARD, keys=EnvKeys(observation="state"))._exclude == [
        "real_desired_goal",
        ("next", "real_desired_goal"),
    ]


@both
def test_an_unknown_option_is_named_with_the_nearest(make: Callable[..., Any]) -> None:
    with pytest.raises(TypeError, match="there is no option 'stratgy'; did you mean 'strategy'?"):
        make(REWARD, stratgy="future")
    with pytest.raises(TypeError, match=r"no option 'zzz'\. The options are k, strategy, .*virtual_key$"):
        make(REWARD, zzz=1)
    with pytest.raises(TypeError, match=r"options must be HindsightOptions or None, got \{'k': 3\}"):
        make(REWARD, {"k": 3})


# Sources of goals


@both
def test_k_and_strategy_are_short_for_one_source(make: Callable[..., Any]) -> None:
    first = relabeled(make, k=3, strategy="episode", filter_achieved=True)
    second = relabeled(make, goal_sources={"episode": 3}, filter_achieved=True)
    assert all(torch.equal(first[key], second[key]) for key in first.keys(True, True))
    assert make(REWARD, goal_sources={"episode": 3}).k == 3
    assert HindsightOptions(k=3, strategy="final").sources == {"final": 3}
    assert HindsightOptions(k=0).sources == {}


@both
def test_sources_take_the_place_of_k_and_strategy(make: Callable[..., Any]) -> None:
    mixed = {"final": 1, "actual": 2, "achieved": 3}
    part = make(REWARD, HindsightOptions(k=8, strategy="episode"), goal_sources=mixed)
    assert (part.k, part.goal_sources, part.options.sources) == (6, mixed, mixed)
    assert part.options.remembered == {"actual": 1_000, "achieved": 2_000}
    assert replace(part.options, keys=EnvKeys(reward="cost")).sources == mixed
    part.goal_sources = {"actual": 1}
    assert (part.k, part.options.remembered) == (1, {"actual": 1_000})
    mixed["future"] = 9  # the options have their own
    assert part.options.sources == {"actual": 1}


@both
def test_two_ways_to_say_which_goals_are_drawn_are_refused(make: Callable[..., Any]) -> None:
    both = "say the same: give one of them"
    with pytest.raises(ValueError, match=rf"k=4 and goal_sources=\{{actual: 1\}} {both}"):
        make(REWARD, goal_sources={"actual": 1}, k=4)
    with pytest.raises(ValueError, match=rf"strategy='future' and goal_sources=\{{final: 1\}} {both}"):
        make(REWARD, goal_sources={"final": 1}, strategy="future")
    part = make(REWARD, goal_sources={"actual": 1})
    with pytest.raises(ValueError, match=rf"k=7 and goal_sources=\{{actual: 1\}} {both}"):
        part.k = 7
    with pytest.raises(ValueError, match=rf"strategy='final' and goal_sources=.* {both}"):
        part.strategy = "final"
    with pytest.raises(ValueError, match=rf"k=2 and strategy='final' and goal_sources=.* {both}"):
        HindsightOptions(k=2, strategy="final", goal_sources={"future": 2, "actual": 2})


@both
def test_without_sources_k_is_what_it_was_by_default(make: Callable[..., Any]) -> None:
    part = make(REWARD, goal_sources={"final": 1, "actual": 1})
    part.goal_sources = None
    assert part.options == HindsightOptions()
    part.goal_sources = {"actual": 2}
    assert part.options.changed({"goal_sources": None, "k": 7}).sources == {"future": 7}
    part = make(REWARD, k=7)
    part.goal_sources = None
    assert part.k == 7


def test_a_k_that_was_given_is_refused_beside_sources_even_if_it_is_the_default() -> None:
    sources = {"future": 2, "actual": 1}
    with pytest.raises(ValueError, match=r"^k=4 and goal_sources=\{future: 2, actual: 1\} say the same"):
        HindsightOptions(k=4, goal_sources=sources)
    with pytest.raises(ValueError, match=r"^strategy='final' and goal_sources="):
        HindsightOptions(strategy="final", goal_sources=sources)
    assert HindsightOptions(k=3, goal_sources=sources).k == 3  # as `replace` gives it
    for options in (HindsightOptions(), pickle.loads(pickle.dumps(HindsightOptions()))):
        assert replace(options, goal_sources=sources).k == 3
        assert repr(options).startswith("HindsightOptions(k=4, ")


@pytest.mark.parametrize(
    ("sources", "error", "message"),
    [
        ({}, ValueError, r"at least one source, as in \{'future': 4\}; k=0 asks for no goals"),
        ({"futur": 2}, ValueError, "'futur'; the sources are future, .*achieved; did you mean 'future'"),
        ({"actual": 0}, ValueError, "whole numbers of at least 1, got 0 for 'actual'"),
        ({"actual": True}, ValueError, "got True for 'actual'"),
        ({"future": 1.5}, ValueError, "got 1.5 for 'future'"),
        ("actual", TypeError, r"must map sources to numbers, as in \{'future': 4\}, got 'actual'"),
    ],
)
def test_sources_that_cannot_be_are_named(sources: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        HindsightOptions(goal_sources=sources)


def test_goals_of_other_episodes_are_no_strategy() -> None:
    with pytest.raises(ValueError, match=r"'actual'.* asked for by goal_sources=\{'actual': 4\}"):
        HindsightOptions(strategy="actual")
    with pytest.raises(ValueError, match="the name 'achieved' is taken"):
        register_strategy("achieved", next_only)
    with pytest.raises(ValueError, match="recent_actual must be at least 1, got 0"):
        HindsightOptions(recent_actual=0)


def test_options_that_cannot_be_are_named_and_options_stay_as_they_are() -> None:
    with pytest.raises(ValueError, match="k must be at least 0, got -1"):
        HindsightOptions(k=-1)
    with pytest.raises(ValueError, match="unknown goal strategy 'nearest'"):
        HindsightOptions(strategy="nearest")
    with pytest.raises(TypeError, match="keys must be given as a list, got 'state'"):
        HindsightOptions(exclude="state")
    options = HindsightOptions()
    with pytest.raises(FrozenInstanceError):
        options.k = 3  # type: ignore[misc]
    assert options.changed({"k": 3}).k == 3
    assert options.k == 4


# Strategies of one's own


def next_only(time: Tensor, lengths: Tensor) -> tuple[Tensor, Tensor]:
    """The goal of the next transition; at the end of an episode its own."""
    goal = torch.minimum(time + 1, lengths - 1)
    return goal, goal + 1


NEXT_ONLY = {(0.0, 1.0), (1.0, 2.0), (2.0, 3.0), (3.0, 3.0)}  # of an episode of four steps


@pytest.fixture
def registered() -> Iterator[str]:
    register_strategy("next_only", next_only)
    yield "next_only"
    del STRATEGIES["next_only"]


class PreferFar(GoalWeights):
    """Weights that make the draw look up likelihoods."""

    def __call__(self, goals: Tensor) -> Tensor:
        return goals[..., 0] + 1.0


@both
@pytest.mark.parametrize("weights", [None, PreferFar()])
def test_a_function_and_its_name_choose_the_goals(
    make: Callable[..., Any], weights: GoalWeights | None, registered: str
) -> None:
    for strategy in (next_only, registered):
        assert lent(relabeled(make, strategy=strategy, weights=weights)) == NEXT_ONLY


@both
def test_the_filter_works_with_a_function(make: Callable[..., Any]) -> None:
    def itself(time: Tensor, lengths: Tensor) -> tuple[Tensor, Tensor]:
        return time, time + 1

    assert lent(relabeled(make, strategy=itself, filter_achieved=True)) == {(i, i) for i in range(4)}


def late(batch: TensorDict) -> TensorDict:
    """An episode of four steps whose achieved goal moves in the third one and the fourth: 0, 0, 0, 1, 2."""
    goals = torch.tensor([0.0, 0.0, 0.0, 1.0, 2.0])
    batch["achieved_goal"][..., 0], batch["next", "achieved_goal"][..., 0] = goals[:-1], goals[1:]
    return batch


@both
@pytest.mark.parametrize(
    ("source", "weighted", "kept"),
    [
        ("future", False, [2 / 4, 2 / 3, 1, 1]),
        ("future", True, [5 / 7, 5 / 6, 1, 1]),
        ("achieved", False, [2 / 4, 2 / 4, 2 / 4, 3 / 4]),
        ("achieved", True, [5 / 7, 5 / 7, 5 / 7, 5 / 7]),
    ],
)
def test_refused_goals_make_no_virtual_transitions(
    make: Callable[..., Any], source: str, weighted: bool, kept: list[float]
) -> None:
    """Goals 0, 0, 1, 2 weigh 1, 1, 2, 3. Refused is 0 in the first three steps, and 1 in the last."""
    k = 10_000
    part = make(
        REWARD,
        goal_sources={source: k},
        filter_achieved=True,
        redraw=False,
        weights=PreferFar() if weighted else None,
    )
    parts = {"writer": part} if make is HERWriter else {"sample_unit": part, "collate_fn": part.relabel}
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(50_000), batch_size=4 * k, **parts)
    buffer.set_rng(torch.Generator().manual_seed(0))
    buffer.extend(late(make_batch([[4]])).squeeze(0))
    rows = buffer[:] if make is HERWriter else buffer.sample()
    virtual = rows[rows["virtual"].squeeze(-1)]
    step = virtual["observation"][:, 0].long()
    assert (virtual["desired_goal"][:, 0] - virtual["achieved_goal"][:, 0]).abs().min() > 0.5
    assert (step.bincount(minlength=4) / k).tolist() == pytest.approx(kept, abs=0.04)  # five deviations


@both
def test_a_function_that_leaves_the_episode_is_refused_when_it_is_used(make: Callable[..., Any]) -> None:
    def beyond(time: Tensor, lengths: Tensor) -> tuple[Tensor, Tensor]:
        return time, lengths + 1

    with pytest.raises(ValueError, match="goal strategy 'beyond' gives step"):
        relabeled(make, strategy=beyond)


@both
@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("k", 2.5, "k must be a whole number, got 2.5"),
        ("k", "4", "k must be a whole number, got '4'"),
        ("k", True, "k must be a whole number, got True"),
        ("n_steps", 2.0, "n_steps must be a whole number, got 2.0"),
        ("recent_achieved", "9", "recent_achieved must be a whole number, got '9'"),
    ],
)
def test_numbers_that_are_not_whole_or_not_finite_are_named(
    make: Callable[..., Any], option: str, value: object, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        make(REWARD, **{option: value})
