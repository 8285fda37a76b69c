"""Policies live in a window, and beside each other: what keys do, and what is counted."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pygame
import pytest
import torch
from PIL import Image
from tensordict import TensorDictBase

from torchrl_her_envs.common.rendering.key_window import Command, KeyWindow
from torchrl_her_recipes import Policy, load_policy, play
from torchrl_her_recipes.cli import main
from torchrl_her_recipes.policies.viewer import Viewer
from torchrl_her_recipes.policies.window import Viewing, show

from ..small import Refused


def still(tensordict: TensorDictBase) -> TensorDictBase:
    return tensordict.set("action", torch.zeros(*tensordict.batch_size, 3))


def to_the_ball(tensordict: TensorDictBase) -> TensorDictBase:
    """What a hand that reaches for the ball does: it is at the goal after some steps."""
    gap = tensordict["desired_goal"] - tensordict["achieved_goal"]
    action = torch.cat([20 * gap, torch.zeros_like(gap[:, :1])], -1)
    return tensordict.set("action", action.clamp(-1, 1))


def acting(forward: Callable[[TensorDictBase], TensorDictBase], name: str) -> Policy:
    policy = load_policy("hand_reach")
    policy.forward, policy.source = forward, name  # type: ignore[method-assign]
    return policy


@pytest.fixture
def viewer() -> Viewer:
    """A policy that achieves all goals beside one that achieves none."""
    return Viewer([acting(to_the_ball, "good"), acting(still, "bad")], goals=2, seed=5, size=32, named=True)


@pytest.fixture
def viewing(viewer: Viewer) -> Viewing:
    return Viewing(viewer)


def test_space_pauses_and_n_takes_one_step(viewing: Viewing) -> None:
    viewing.tick()
    assert viewing.status() == "goals 1 to 2, step 1 of 50, 12 steps a second"
    viewing.handle(Command.PAUSE)
    viewing.tick()
    assert viewing.status() == "goals 1 to 2, step 1 of 50, paused"
    viewing.handle(Command.STEP)
    assert viewing.status() == "goals 1 to 2, step 2 of 50, paused"
    viewing.handle(Command.PAUSE)
    viewing.handle(Command.STEP)  # one step is one step: it pauses
    viewing.tick()
    assert viewing.status() == "goals 1 to 2, step 3 of 50, paused"


def test_plus_and_minus_change_the_speed_within_limits(viewing: Viewing) -> None:
    rates = []
    for command in [Command.FASTER] * 5 + [Command.SLOWER] * 9:
        viewing.handle(command)
        rates.append(viewing.rate)
    assert rates == [25, 50, 100, 200, 200, 100, 50, 25, 12, 8, 4, 2, 1, 1]


def test_goals_are_the_same_for_all_and_the_counts_are_of_all_that_was_seen(
    viewing: Viewing, viewer: Viewer
) -> None:
    goals = [own.desired_goal for own in viewer._episodes]
    assert goals[0].equal(goals[1])
    while viewer.running:
        viewing.tick()
    assert viewer.seen == [(2, 2), (0, 2)]
    frozen = viewing.frame()
    for _ in range(viewing.rate):  # a second to see how it ended
        viewing.tick()
        assert viewing.frame().equal(frozen)
    viewing.tick()
    assert viewing.status().startswith("goals 3 to 4, step 0 of 50")
    assert viewer.seen == [(2, 2), (0, 2)]
    viewing.tick()
    viewing.handle(Command.RESET)  # these were neither achieved nor missed
    goals = [own.desired_goal for own in viewer._episodes]
    assert goals[0].equal(goals[1])
    assert viewing.status().startswith("goals 5 to 6, step 0 of 50")
    assert viewer.seen == [(2, 2), (0, 2)]


def test_a_single_goal_of_few_coordinates_is_written_out() -> None:
    viewer = Viewer([acting(still, "mine")], goals=1, seed=5, size=32)
    viewing = Viewing(viewer)
    x, y = viewer.desired_goal[0].tolist()
    assert viewing.status() == f"goal 1 at ({x:.2f}, {y:.2f}), step 0 of 50, 12 steps a second"


class Script(KeyWindow):
    """A window in which somebody presses keys at given looks."""

    def __init__(self, keys: dict[int, list[Command]]) -> None:
        self.keys, self.pictures, self.rates = keys, [], []

    def show(self, picture: np.ndarray) -> None:
        self.pictures.append(picture)

    def commands(self) -> list[Command]:
        return self.keys.get(len(self.pictures), [])

    def wait(self, rate: float) -> None:
        self.rates.append(rate)

    def close(self) -> None:
        raise AssertionError("it belongs to somebody else")


def test_keys_are_looked_for_often_however_slow_the_steps_are(viewing: Viewing, viewer: Viewer) -> None:
    window = Script({1: [Command.SLOWER] * 3, 61: [Command.FASTER] * 6, 71: [Command.QUIT]})
    show(viewing, window)
    assert len(window.pictures) == 71
    assert window.rates == [30] * 61 + [100] * 10
    # 2 steps a second for two seconds, then 100 a second for nine looks, and none once it is over.
    assert viewer.step_count == 4 + 9


# On the command line


@pytest.fixture
def dummy(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    pygame.display.init()
    yield
    pygame.display.quit()


def press(*keys: int) -> None:
    for key in keys:
        pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=key, unicode=""))


@pytest.mark.usefixtures("dummy")
def test_a_policy_in_a_window_beside_another(capsys: pytest.CaptureFixture[str]) -> None:
    main(["export", "hand_reach", "--out", "other.safetensors", "--no-card"])
    capsys.readouterr()
    press(*[pygame.K_n] * 50, pygame.K_ESCAPE)
    assert main(["play", "hand_reach", "--window", "--compare", "other.safetensors", "--size", "64"]) == 0
    out = capsys.readouterr().out.splitlines()
    assert [re.sub(r"\d+ of (\d+)", r"N of \1", line) for line in out] == [
        f"N of {n} goals achieved: {name}"
        for n, name in zip(
            (line.split()[2] for line in out), ("hand_reach", "other.safetensors"), strict=True
        )
    ]
    assert out[0].split()[:3] == out[1].split()[:3]  # the same policy does the same
    assert int(out[0].split()[2]) >= 1
    assert not pygame.display.get_init()


@pytest.mark.usefixtures("dummy")
def test_what_cannot_be_shown_is_one_line(monkeypatch: pytest.MonkeyPatch, refused: Refused) -> None:
    for arguments, message in (
        (["--window", "--out", "a.gif"], "--window and --out cannot be given together"),
        (["--window", "--compare", "nowhere"], "nowhere is neither the folder of a run"),
        (
            ["--window", "--compare", "robot_reach"],
            "can be compared: hand_reach plays hand_reach, and robot_reach plays robot_reach",
        ),
        (["--compare", "robot_reach"], "only policies of the same task can be compared"),
    ):
        assert message in refused("play", "hand_reach", *arguments)
    pygame.display.quit()
    monkeypatch.delenv("SDL_VIDEODRIVER")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    said = refused("play", "hand_reach", "--window")
    assert "a window needs a display, and there is none" in said


def test_a_film_of_several_policies_has_them_beside_each_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    main(["export", "hand_reach", "--out", "other.safetensors", "--no-card"])
    capsys.readouterr()
    compared = ["--compare", "other.safetensors", "--compare", "hand_reach", "--goals", "2", "--size", "64"]
    assert main(["play", "hand_reach", *compared]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "2 of 2 goals achieved: hand_reach",
        "2 of 2 goals achieved: other.safetensors",
        "2 of 2 goals achieved: hand_reach",
        "hand_reach_compare.gif",
    ]
    with Image.open("hand_reach_compare.gif") as film:
        wide, high = film.size
        assert wide == 3 * 2 * 64 + 2 * 8  # three of two, with gaps
        assert high == 64 + 2 * 16  # and two lines
        assert film.n_frames > 3
        first = np.asarray(film.convert("RGB"))
    assert np.array_equal(first[:64, :128], first[:64, 136:264])  # the same starts and goals
    assert play("hand_reach", out="single.gif", goals=3, size=32, seed=4) == [(3, 3)]
