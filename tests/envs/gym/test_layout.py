"""Nested observations and goals as rows of numbers, and back: numbers written by hand."""

from __future__ import annotations

from collections import OrderedDict
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from torchrl.envs.utils import check_env_specs

from torchrl_her_envs import make_gym_env
from torchrl_her_envs.gym.layout import Layout

ONE = spaces.Box(-9.0, 9.0, (1,), np.float64)


def nested() -> spaces.Dict:
    """Listed in another order than the alphabetical one, at both levels."""
    inner = spaces.Dict(OrderedDict(turn=spaces.Box(-9, 9, (2, 2), np.float64), grip=spaces.Discrete(5)))
    return spaces.Dict(OrderedDict(hand=inner, arm=spaces.Box(-9, 9, (2,), np.float32)))


def test_entries_follow_the_alphabet_at_every_level_and_arrays_row_by_row() -> None:
    layout = Layout(nested(), "goal")
    values = {"hand": {"turn": np.array([[1.0, 2.0], [3.0, 4.0]]), "grip": 7}, "arm": np.array([8.0, 9.0])}
    assert layout.entries == ["arm", "hand.grip", "hand.turn"]
    assert layout.flatten(values).tolist() == [8.0, 9.0, 7.0, 1.0, 2.0, 3.0, 4.0]
    assert layout.width == 7


def test_a_space_that_lists_its_keys_in_another_order_gives_the_same_rows() -> None:
    one = spaces.Dict(OrderedDict(x=ONE, y=ONE))
    other = spaces.Dict(OrderedDict(y=ONE, x=ONE))
    values = {"y": np.array([2.0]), "x": np.array([1.0])}
    for space in (one, other):
        assert Layout(space, "goal").flatten(values).tolist() == [1.0, 2.0]
    assert Layout(one, "goal").shapes == Layout(other, "goal").shapes


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_there_and_back_with_any_leading_dimensions(batch: tuple[int, ...]) -> None:
    layout = Layout(nested(), "goal")
    rows = np.arange(np.prod((*batch, 7)), dtype=np.float32).reshape(*batch, 7)
    values = layout.unflatten(rows)
    assert values["hand"]["turn"].shape == (*batch, 2, 2)
    assert (values["arm"].dtype, values["hand"]["grip"].dtype) == (np.float32, np.int64)
    assert values["hand"]["grip"].shape == batch
    assert np.array_equal(layout.flatten(values), rows)


def test_a_vector_stays_one() -> None:
    layout = Layout(spaces.MultiBinary(3), "goal")
    assert (layout.entries, layout.width) == ([], 3)
    assert layout.unflatten(np.array([1.0, 0.0, 1.0])).dtype == np.int8


def test_whole_numbers_are_rounded() -> None:
    whole = Layout(spaces.Box(-9, 9, (4,), np.int32), "action").unflatten(np.array([0.4, 0.6, 2.999, -1.7]))
    assert (whole.tolist(), whole.dtype) == ([0, 1, 3, -2], np.int32)


@pytest.mark.parametrize(("value", "got"), [(np.nan, "nan"), (-np.inf, "-inf"), (1e300, r"1e\+300")])
def test_a_number_that_float32_cannot_hold_is_named(value: float, got: str) -> None:
    with pytest.raises(ValueError, match=f"^Env-v0: observation 2 must be a finite number, got {got}$"):
        Layout(spaces.Box(-np.inf, np.inf, (3,)), "Env-v0: observation").flatten(
            np.array([[0.0, 1.0, value]])
        )
    turned = {"arm": np.zeros(2), "hand": {"grip": 0, "turn": np.array([[0.0, 0.0], [value, 0.0]])}}
    with pytest.raises(ValueError, match=f"^goal.hand.turn 2 must be a finite number, got {got}$"):
        Layout(nested(), "goal").flatten(turned)


@pytest.mark.filterwarnings("error")
def test_half_precision_is_checked_like_other_numbers() -> None:
    layout = Layout(spaces.Box(-np.inf, np.inf, (2,), np.float16), "seen")
    assert layout.flatten(np.array([1.5, 60_000], np.float16)).tolist() == [1.5, 60_000]
    with pytest.raises(ValueError, match="^seen 1 must be a finite number, got inf$"):
        layout.flatten(np.array([0.0, np.inf], np.float16))


@pytest.mark.parametrize(
    ("space", "message"),
    [
        (spaces.Text(3), "'x' must be numbers or a dictionary of arrays, got Text"),
        (spaces.Dict(a=spaces.Dict(b=spaces.Text(3))), "got Text.* in a.b"),
        (spaces.Dict({}), "'x' has an empty dictionary"),
    ],
)
def test_what_has_no_numbers_is_named(space: spaces.Space, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Layout(space, "'x'")


class Crane(gymnasium.Env):
    """A hook at (x, height) and a load beside it: nested goals, of which the height counts ten times."""

    def __init__(self) -> None:
        goal = spaces.Dict(OrderedDict(place=spaces.Dict(x=ONE), height=ONE))
        shown = spaces.Dict(OrderedDict(speed=ONE, hook=spaces.Dict(b=ONE, a=ONE)))
        self.observation_space = spaces.Dict(observation=shown, achieved_goal=goal, desired_goal=goal)
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.asked: list[Any] = []

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.at, self.goal = np.array([1.0, 2.0]), np.array([3.0, float(self.np_random.integers(4, 6))])
        return self._show(), {}

    def step(self, action: np.ndarray) -> Any:
        self.at = self.at + np.round(action)
        reward = self.compute_reward(self._place(self.at), self._place(self.goal), {})
        return self._show(), float(reward), False, False, {}

    def compute_reward(self, achieved: dict[str, Any], desired: dict[str, Any], info: Any) -> Any:
        self.asked.append(achieved)
        gap = np.abs(achieved["place"]["x"] - desired["place"]["x"])
        gap = gap + 10 * np.abs(achieved["height"] - desired["height"])
        return -(gap[..., 0] > 5).astype(np.float64)

    def _place(self, at: np.ndarray) -> dict[str, Any]:
        return {"height": at[1:], "place": {"x": at[:1]}}

    def _show(self) -> dict[str, Any]:
        shown = {"hook": {"a": np.array([10.0]), "b": np.array([20.0])}, "speed": np.array([30.0])}
        goals = {"achieved_goal": self._place(self.at), "desired_goal": self._place(self.goal)}
        return {"observation": shown, **goals}


gymnasium.register("tests/Crane-v0", Crane, max_episode_steps=5)


def test_an_environment_with_nested_dictionaries_is_shown_as_vectors() -> None:
    env = make_gym_env("tests/Crane-v0", num_envs=2)
    check_env_specs(env)
    shown = env.reset()
    assert shown["observation"].tolist() == [[10.0, 20.0, 30.0]] * 2  # hook.a, hook.b, speed
    assert shown["achieved_goal"].tolist() == [[2.0, 1.0]] * 2  # height, place.x
    after = env.step(shown.set("action", torch.tensor([[1.0, 0.0], [0.0, -1.0]])))["next"]
    assert after["achieved_goal"].tolist() == [[2.0, 2.0], [1.0, 1.0]]


def test_its_functions_get_goals_in_their_original_form_in_one_call() -> None:
    env = make_gym_env("tests/Crane-v0")
    assert env._reward_of.answers == "batch"
    asked = env._reference_env.unwrapped.asked
    asked.clear()
    achieved = torch.tensor([[4.0, 3.0], [4.0, 9.0], [5.0, 3.0]])  # height, place.x
    reward = env.compute_reward(achieved, torch.tensor([4.0, 3.0]))
    assert reward.tolist() == [[0.0], [-1.0], [-1.0]]
    (given,) = asked
    assert given["height"].tolist() == [[4.0], [4.0], [5.0]]
    assert given["place"]["x"].tolist() == [[3.0], [9.0], [3.0]]


def test_goals_of_different_forms_are_refused() -> None:
    class Other(Crane):
        def __init__(self) -> None:
            super().__init__()
            goal = spaces.Dict(height=ONE, place=spaces.Dict(y=ONE))
            self.observation_space = spaces.Dict({**self.observation_space.spaces, "desired_goal": goal})

    gymnasium.register("tests/OtherCrane-v0", Other, max_episode_steps=5)
    with pytest.raises(ValueError, match=r"goals must have one shape, got Dict\(.*'x'.* and Dict\(.*'y'"):
        make_gym_env("tests/OtherCrane-v0")


def test_rows_of_a_batch_are_not_mistaken_for_dimensions_of_a_goal() -> None:
    """Three coordinates and then two: the batch that functions are tried with is of neither size."""
    three, two = spaces.Box(-9, 9, (3,), np.float64), spaces.Box(-9, 9, (4,), np.float64)
    sizes = Layout(spaces.Dict(a=three, b=two), "goal").sizes
    assert sizes == {3, 4}
