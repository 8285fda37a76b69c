"""Goal strategies by hand: those that there are, registered ones, and functions."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
import torch
from torch import Tensor

from torchrl_her import register_strategy
from torchrl_her.goals import STRATEGIES, candidate_range, candidates, get_strategy, strategy_name
from torchrl_her.goals.strategies import check_goal_sources, sources_name


def test_an_unknown_strategy_is_named_with_those_that_there_are() -> None:
    with pytest.raises(ValueError, match="'past'.*future, final, episode"):
        candidates("past", torch.tensor([3]), 4)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("strategy", "first", "end"),
    [("future", [0, 1, 2], [3, 3, 3]), ("final", [2, 2, 2], [3, 3, 3]), ("episode", [0, 0, 0], [3, 3, 3])],
)
def test_windows_of_an_episode_of_three(strategy: str, first: list[int], end: list[int]) -> None:
    window_ = candidate_range(strategy, torch.arange(3), torch.tensor(3))  # type: ignore[arg-type]
    assert [edge.tolist() for edge in window_] == [first, end]


def test_the_nearest_name_is_proposed() -> None:
    with pytest.raises(ValueError, match="unknown goal strategy 'futur'; .*did you mean 'future'"):
        get_strategy("futur")
    with pytest.raises(ValueError, match="unknown goal strategy 3; .* are future, final, episode$"):
        get_strategy(3)  # type: ignore[arg-type]


def at_most_two_steps(time: Tensor, lengths: Tensor) -> tuple[Tensor, Tensor]:
    """This transition and the next one."""
    return time, torch.minimum(time + 2, lengths)


@pytest.fixture
def registered() -> Iterator[str]:
    register_strategy("at_most_two_steps", at_most_two_steps)
    yield "at_most_two_steps"
    del STRATEGIES["at_most_two_steps"]


def test_a_registered_strategy_by_hand(registered: str) -> None:
    first, end = candidate_range(registered, torch.arange(4), torch.tensor(4))
    assert (first.tolist(), end.tolist()) == ([0, 1, 2, 3], [2, 3, 4, 4])
    expected = [[1, 1, 0, 0], [0, 1, 1, 0], [0, 0, 1, 0], [0, 0, 0, 0]]
    for strategy in (registered, at_most_two_steps):
        assert candidates(strategy, torch.tensor(3), 4).int().tolist() == expected
    assert strategy_name(registered) == strategy_name(at_most_two_steps) == registered


def test_a_function_may_give_one_number_for_all() -> None:
    first, end = candidate_range(
        lambda _time, lengths: (torch.tensor(0), lengths), torch.arange(3), torch.tensor(3)
    )
    assert (first.tolist(), end.tolist()) == ([0, 0, 0], [3, 3, 3])


def test_names_are_given_once(registered: str) -> None:
    for name in ("future", registered):
        with pytest.raises(ValueError, match=f"the name '{name}' is taken"):
            register_strategy(name, lambda time, lengths: (time, lengths))
    assert get_strategy("future")(torch.tensor(0), torch.tensor(2)) == (0, 2)
    assert get_strategy(registered) is at_most_two_steps
    with pytest.raises(ValueError, match="the name 'future' is taken"):
        register_strategy("future", at_most_two_steps)
    with pytest.raises(ValueError, match="needs a name, got ''"):
        register_strategy("", at_most_two_steps)
    with pytest.raises(TypeError, match="goal strategy 'none' must be a function, got 7"):
        register_strategy("none", 7)  # type: ignore[arg-type]
    assert "none" not in STRATEGIES


def test_a_function_that_is_defined_again_replaces_itself(registered: str) -> None:
    cell = "def at_most_two_steps(time, lengths):\n    return time, lengths"
    again: dict[str, Any] = {"__name__": __name__}
    exec(cell, again)
    register_strategy(registered, again["at_most_two_steps"])
    assert get_strategy(registered) is again["at_most_two_steps"]
    elsewhere: dict[str, Any] = {"__name__": "another_module"}
    exec(cell, elsewhere)
    with pytest.raises(ValueError, match="the name 'at_most_two_steps' is taken"):
        register_strategy(registered, elsewhere["at_most_two_steps"])


@pytest.mark.parametrize(
    ("shift", "message"),
    [
        ((0, 1), r"step 0 of an episode of 3 the candidates first=0, end=4, but 0 <= first < end <= 3"),
        ((-1, 0), "first=-1, end=3"),
        ((3, 0), "first=3, end=3"),  # none at all
    ],
)
def test_a_strategy_that_leaves_the_episode_is_named(shift: tuple[int, int], message: str) -> None:
    def astray(time: Tensor, lengths: Tensor) -> tuple[Tensor, Tensor]:
        return torch.zeros_like(time) + shift[0], lengths + shift[1]

    with pytest.raises(ValueError, match=f"goal strategy 'astray' gives .*{message}"):
        candidate_range(astray, torch.arange(3), torch.tensor(3))


@pytest.mark.parametrize(
    ("first", "got"),
    [
        (torch.zeros(3), "torch.float32 and torch.int64"),
        (torch.zeros(3, dtype=torch.bool), "torch.bool and torch.int64"),
        (0, "0 and torch.int64"),
    ],
)
def test_a_strategy_that_returns_no_steps_is_named(first: Any, got: str) -> None:
    def rounded(_time: Tensor, lengths: Tensor) -> tuple[Tensor, Tensor]:
        return first, lengths

    message = f"goal strategy 'rounded' must return two int64 tensors, first and end, got {got}$"
    with pytest.raises(ValueError, match=message):
        candidate_range(rounded, torch.arange(3), torch.tensor(3))


def test_functions_are_sources_too() -> None:
    given = {at_most_two_steps: 2, "achieved": 1, "final": 1}
    sources = check_goal_sources(given)
    assert sources == given
    assert sources_name(sources) == "at_most_two_steps: 2, achieved: 1, final: 1"


def test_numbers_are_made_plain_and_the_mapping_is_a_copy() -> None:
    given = {"future": torch.ones(3, dtype=torch.int64).numpy().sum()}
    checked = check_goal_sources(given)
    assert type(checked["future"]) is int
    given["future"] = 9
    assert checked == {"future": 3}
