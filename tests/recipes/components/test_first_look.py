"""What ends episodes at their goals is found once, before anything is made of a recipe."""

from __future__ import annotations

import logging
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import yaml
from gymnasium import spaces

from torchrl_her_envs import make_env
from torchrl_her_envs.common import goal_rules
from torchrl_her_recipes import RunFolder, build, look_at, make_recipe, run
from torchrl_her_recipes.cli import main
from torchrl_her_recipes.components import first_look
from torchrl_her_recipes.components.first_look import resolved
from torchrl_her_recipes.config.imports import allow_imports

TASK = "gym:tests/Seldom-v0"
SIZES = {"hidden": 8, "num_envs": 2, "epoch_frames": 40, "epochs": 1, "episodes": 2, "pictures": False}


class Seldom(gymnasium.Env):
    """A walk along a line, whose goal is within reach in a few episodes only.

    Args:
        near: the share of these episodes.
        stops: whether the goal ends an episode.
        own: what compute_terminated says of an achieved goal; None without the method.
        cost: of each step, which compute_reward does not know.
        lasts: steps after which the environment ends an episode by itself.
    """

    def __init__(
        self,
        *,
        near: float = 0.03,
        stops: bool = True,
        own: bool | None = None,
        cost: float = 0.0,
        lasts: int = 99,
    ) -> None:
        line = spaces.Box(-np.inf, np.inf, (1,), np.float32)
        self.observation_space = spaces.Dict(observation=line, achieved_goal=line, desired_goal=line)
        self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.near, self.stops, self.cost, self.lasts = near, stops, cost, lasts
        if own is not None:
            self.compute_terminated = lambda achieved, desired, info: own & (self._gap(achieved, desired) < 1)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, Any]:
        super().reset(seed=seed)
        self.steps = 0
        self.place, self.goal = 0.0, 1.0 if self.np_random.random() < self.near else 50.0
        return self._show(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps, self.place = self.steps + 1, self.place + float(action[0])
        shown = self._show()
        goals = shown["achieved_goal"], shown["desired_goal"]
        met = bool(self._gap(*goals) < 1)
        ends = (self.stops and met) or self.steps == self.lasts
        return shown, float(self.compute_reward(*goals, {})) - self.cost, ends, False, {}

    def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, info: Any) -> Any:
        return (self._gap(achieved, desired) < 1) - 1.0

    def _gap(self, achieved: np.ndarray, desired: np.ndarray) -> Any:
        return np.abs(achieved - desired)[..., 0]

    def _show(self) -> dict[str, np.ndarray]:
        values = {"observation": self.place, "achieved_goal": self.place, "desired_goal": self.goal}
        return {key: np.array([value], np.float32) for key, value in values.items()}


gymnasium.register("tests/Seldom-v0", Seldom, max_episode_steps=10)


@pytest.fixture
def said(caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> pytest.LogCaptureFixture:
    monkeypatch.setattr(goal_rules, "_said", set())
    monkeypatch.setattr(first_look, "_FACTS", {})
    caplog.set_level(logging.INFO, "torchrl_her_envs")
    return caplog


def never_looks(monkeypatch: pytest.MonkeyPatch) -> None:
    def look(*_: Any, **__: Any) -> None:
        raise AssertionError("it was looked at again")

    monkeypatch.setattr(first_look, "look_at", look)
    monkeypatch.setattr(first_look, "_FACTS", {})


@pytest.mark.parametrize(
    ("options", "ends", "line"),
    [
        ({}, "reward", "random steps it ended where a goal was achieved"),
        ({"cost": 0.25}, "reward", "ended where a goal was achieved"),
        ({"stops": False}, "never", "it went on after a goal was achieved"),
        ({"near": 0.0}, "never", "no goal was achieved in 3,240 random steps"),
        ({"own": True}, "own", None),
        ({"own": False, "stops": False}, "never", None),
    ],
)
def test_what_ends_episodes_is_found_by_many_steps_and_said_once(
    options: dict[str, Any], ends: str, line: str | None, said: pytest.LogCaptureFixture
) -> None:
    for seed in (0, 1):
        recipe = resolved(make_recipe(task=TASK, seed=seed, **{"task.options": options}))
        found = {"termination": ends, **({"shaping": [1.0, 10.0]} if options == {"near": 0.0} else {})}
        assert recipe.task.options == {**options, **found}
    lines = [own.getMessage() for own in said.records if own.levelno == logging.INFO]
    assert len(lines) == (line is not None)
    assert line is None or line in lines[0]


def test_two_hundred_steps_show_too_little(said: pytest.LogCaptureFixture) -> None:
    env = make_env(TASK)
    assert env.ends == "never"
    assert "no goal was achieved in 200 random steps" in said.records[0].getMessage()


def test_a_run_keeps_what_was_found_and_nobody_looks_again(
    tmp_path: Path, said: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    run(build(make_recipe(task=TASK, **SIZES)), tmp_path / "run", progress=False)
    assert len(said.records) == 1
    options = yaml.safe_load((tmp_path / "run" / "config.yaml").read_text())["task"]["options"]
    assert options == {"termination": "reward"}
    never_looks(monkeypatch)
    with allow_imports():
        build(RunFolder(tmp_path / "run").recipe()).close()
    assert len(said.records) == 1


def test_an_environment_that_is_defined_again_is_looked_at_again() -> None:
    """As by a notebook's cell: the same name stands for another environment."""
    found = []
    for stops, steps in ((True, 10), (False, 50)):
        gymnasium.registry.pop("tests/Again-v0", None)
        gymnasium.register("tests/Again-v0", partial(Seldom, stops=stops), max_episode_steps=steps)
        recipe = resolved(make_recipe(task="gym:tests/Again-v0", algo="her"))
        found.append(((recipe.task.options or {})["termination"], recipe.learner.gamma))
    assert found == [("reward", 0.9), ("never", 0.96)]


def test_what_is_given_and_what_environments_say_themselves_is_not_looked_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    never_looks(monkeypatch)
    given = make_recipe(task=TASK, algo="her", **{"task.options": {"termination": "reward"}})
    assert resolved(given).task == given.task
    assert resolved(make_recipe(task="hand_v0")).task.options is None
    own = make_recipe(task=TASK, algo="her", **{"task.options": {"own": True}})
    assert (resolved(own).task.options or {})["termination"] == "own"
    complete = make_recipe(task="torchrl_her_envs:BitFlip", **{"task.options": {"bits": 4}})
    assert resolved(complete).task.options == {"bits": 4}


@pytest.mark.parametrize(
    ("options", "failed"), [({"near": 0.0, "lasts": 4}, 1.0), ({"near": 0.0}, 0.0), ({"near": 1.0}, 0.0)]
)
def test_ends_without_goals_are_counted_in_whole_episodes(options: dict[str, Any], failed: float) -> None:
    """Eight environments are played for ten steps, ten times; of each, two steps are no episode."""
    facts = look_at(make_recipe(task=TASK, **{"task.options": options}), steps=800)
    assert facts.fallen == failed
    if "lasts" in options:
        assert (facts.steps, facts.episodes) == (800, 160)


@pytest.mark.parametrize(
    ("task", "more", "shaping"),
    [
        ({"near": 0.0}, {}, [1.0, 10.0]),
        ({"near": 0.0, "shaping": [1.0, 5.0]}, {}, [1.0, 5.0]),
        ({"near": 0.0}, {"algo": "filtered_her"}, None),
        ({"near": 1.0}, {}, None),
        ({"near": 0.0, "lasts": 4}, {}, None),
    ],
    ids=["far away", "given", "not asked for", "within reach", "failures"],
)
def test_small_goals_far_away_get_shaped_rewards(
    task: dict[str, Any], more: dict[str, Any], shaping: list[float] | None
) -> None:
    recipe = resolved(make_recipe(task=TASK, **{"task.options": task}, **more))
    assert recipe.task.options is not None
    assert recipe.task.options.get("shaping") == shaping
    assert recipe.hindsight.algo == "filtered_her"


def test_what_was_chosen_is_said(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    sizes = [f"{name}={value}" for name, value in SIZES.items()]
    assert main(["train", f"task={TASK}", "task.options.near=0.0", *sizes, f"folder={tmp_path / 'run'}"]) == 0
    assert "algo=auto chose task.options.shaping=[1.0, 10.0], since random actions" in capsys.readouterr().out
