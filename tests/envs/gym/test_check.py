"""What is said of gymnasium environments that cannot be used."""

from __future__ import annotations

import importlib
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from torchrl_her_envs import make_gym_env
from torchrl_her_envs.gym.check import coarse_goals

from .walk import WALK, Walk, walk

TO_TARGET = spaces.Box(-1.0, 1.0, (2,), np.float64)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"without": "desired_goal"}, "must have 'desired_goal', got .*achieved_goal, observation"),
        ({"without": "compute_reward"}, "lacks the method 'compute_reward'"),
        ({"shown": TO_TARGET}, "must be a dict of observation, achieved_goal, desired_goal, got a Box"),
        ({"shown": {"desired_goal": TO_TARGET}}, r"must have one shape, got \(1,\) and \(2,\)"),
        ({"shown": {"achieved_goal": spaces.Text(5)}}, "'s 'achieved_goal' must be numbers"),
        ({"actions": spaces.MultiBinary(2)}, r"must be a Box or Discrete, got MultiBinary\(2\)"),
        ({"actions": spaces.Box(-np.inf, np.inf, (2,))}, "actions must have bounds"),
    ],
)
def test_what_an_environment_lacks_is_named(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=f"^{WALK}.* ?{message}") as raised:
        walk(**options)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("id", "message"),
    [
        ("tests/Wlak-v0", "cannot make .* 'tests/Wlak-v0': .*Walk"),
        ("tests/Walk-v9", "cannot make .* 'tests/Walk-v9': .*version"),
        ("nowhere/Walk-v0", "cannot make .* 'nowhere/Walk-v0': .*nowhere"),
    ],
)
def test_ids_that_there_are_not(id: str, message: str) -> None:
    with pytest.raises(ValueError, match=message) as raised:
        make_gym_env(id)
    assert "\n" not in str(raised.value)


def test_a_module_that_is_not_there_is_named() -> None:
    with pytest.raises(ImportError, match="cannot make .* 'no_such_module:Env-v0': .*no_such_module"):
        make_gym_env("no_such_module:Env-v0")


@pytest.mark.parametrize(
    ("absent", "said"),
    [("gymnasium_robotics", "is not installed"), ("glfw", "fails: No module named 'glfw'")],
)
def test_what_to_install_is_said(absent: str, said: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise ModuleNotFoundError(f"No module named {absent!r}", name=absent)

    monkeypatch.setattr(importlib, "import_module", missing)
    with pytest.raises(ValueError, match=rf"\(gymnasium-robotics {said}: pip install '.\[robotics\]'\)"):
        make_gym_env("FetchStand-v4")


def test_an_option_that_an_environment_does_not_take_is_named() -> None:
    ours = "max_steps, parallel, termination, achieved_reward, info_keys, shaping, "
    ours += "observation_key, achieved_goal_key, desired_goal_key, pictures"
    allowed = f"{ours}, ends, form, without, actions, shown, render_mode"
    with pytest.raises(ValueError, match=f"^{WALK} takes no option 'color'; its options are {allowed}$"):
        walk(color="red")
    with pytest.raises(
        ValueError, match="torchrl_her/HandReach-v0 takes no option 'task_name'; .* threshold$"
    ):
        make_gym_env("torchrl_her/HandReach-v0", task_name="hand_v0")


def test_environments_that_take_any_option_and_fail_do_so_in_one_line() -> None:
    gymnasium.register("tests/Wrong-v0", lambda **options: len(3), max_episode_steps=3)
    with pytest.raises(ValueError, match=r"cannot make .* 'tests/Wrong-v0': object of type 'int'") as raised:
        make_gym_env("tests/Wrong-v0", size=3)
    assert "\n" not in str(raised.value)


class NoSeed(Walk):
    def reset(self) -> Any:  # type: ignore[override]
        return super().reset()


class NoInfo(Walk):
    def reset(self, **options: Any) -> Any:
        return super().reset(**options)[0]


class OneDone(Walk):
    def step(self, action: Any) -> Any:
        shown, reward, terminated, truncated, info = super().step(action)
        return shown, reward, terminated or truncated, info


class OldWrapper(gymnasium.Wrapper):
    def step(self, action: Any) -> Any:
        shown, reward, terminated, truncated, info = super().step(action)
        return shown, reward, terminated or truncated, info


@pytest.mark.parametrize(
    ("made", "message"),
    [
        (NoSeed, "reset of NoSeed must take seed and options, as in gymnasium; it lacks 'seed'"),
        (NoInfo, r"reset of NoInfo must give \(observation, info\), as in gymnasium, got a dict"),
        (OneDone, r"step of OneDone must give \(.*, terminated, truncated, info\), .* got 4 values"),
        (lambda: OldWrapper(Walk()), "step of OldWrapper must give .* got 4 values"),
    ],
)
@pytest.mark.parametrize("limit", [6, None])
def test_methods_of_old_gym_are_named(made: Any, message: str, limit: int | None) -> None:
    gymnasium.register("tests/Old-v0", made, max_episode_steps=limit)
    with pytest.raises(ValueError, match=f"^tests/Old-v0: {message}$"):
        make_gym_env("tests/Old-v0")
    del gymnasium.registry["tests/Old-v0"]


def test_goals_that_float32_rounds_are_said() -> None:
    near = np.random.default_rng(0).uniform(-4.0, 4.0, (100, 2))
    assert coarse_goals("Boat-v0", near) == ""
    assert coarse_goals("Boat-v0", near * 0 + 5_334_760.5) == ""  # they never change
    noise = near * np.array([1.0, 1e-8]) + np.array([0.0, 0.42])  # the height of a puck that slides
    assert coarse_goals("Boat-v0", noise) == ""
    said = coarse_goals("Boat-v0", near + np.array([0.0, 5_334_760.5]))
    assert said.startswith("Boat-v0: achieved_goal 1 is about 5,334,764, where float32 has steps of 0.5, and")
