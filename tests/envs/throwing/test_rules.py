"""One step in plain numbers and in arrays: the same rules, the same worlds."""

from __future__ import annotations

import numpy as np
import pytest

from torchrl_her_envs import TASKS, get_task
from torchrl_her_envs.throwing import core as core_module
from torchrl_her_envs.throwing.core import ThrowingCore


def play(task: str, *, steps: int = 160, num_links: int = 2) -> np.ndarray:
    """[steps, 3, ...] what three worlds show; half of the balls start in flight, and episodes begin again."""
    core = ThrowingCore(get_task(task), 3, num_links=num_links, dtype=np.float64)
    core.set_seeds([4])
    core.begin(np.arange(3))
    core.worlds.ball[0] = core.worlds.ball[0].new_tensor([1.0, 2.0])
    core.worlds.ball_velocity[0] = core.worlds.ball[0].new_tensor([6.0, 5.0])
    core.worlds.free[0], core.worlds.held[0] = True, False
    rng, shown = np.random.default_rng(1), []
    for step in range(steps):
        core.advance(rng.uniform(-1.3, 1.3, (3, core.effector.num_joints + 1)))
        shown.append(core.show().state)
        if step % 40 == 39:
            core.begin(np.array([1, 2]))
    return np.stack(shown)


@pytest.mark.parametrize("task", TASKS)
def test_numbers_and_arrays_give_the_same_worlds(task: str, monkeypatch: pytest.MonkeyPatch) -> None:
    paths = []
    for few in (3, 0):
        monkeypatch.setattr(core_module, "_FEW", few)
        paths.append(play(task))
    assert np.abs(np.diff(paths[0], axis=0)).max() > 0.1
    np.testing.assert_allclose(*paths, rtol=0, atol=1e-12)


@pytest.mark.parametrize("links", [1, 4])
def test_so_do_other_arms(links: int, monkeypatch: pytest.MonkeyPatch) -> None:
    paths = []
    for few in (3, 0):
        monkeypatch.setattr(core_module, "_FEW", few)
        paths.append(play("robot_v2", num_links=links))
    np.testing.assert_allclose(*paths, rtol=0, atol=1e-12)


@pytest.mark.parametrize("few", [3, 0])
def test_a_released_ball_has_the_velocity_of_the_grip(few: int, monkeypatch: pytest.MonkeyPatch) -> None:
    # A held ball always has it; in a state that was written by hand it may not.
    monkeypatch.setattr(core_module, "_FEW", few)
    core = ThrowingCore(get_task("hand_v0"), 2)
    core.set_seeds([0])
    core.begin(np.arange(2))
    for point in (core.worlds.grip, core.worlds.ball):
        point[:] = point.new_tensor([1.5, 3.0])
    core.worlds.grip_velocity[:] = core.worlds.grip.new_tensor([3.0, 2.0])
    core.advance(np.array([[1.0, 1.0, -1.0]] * 2))
    np.testing.assert_allclose(core.worlds.ball_velocity.numpy(), [[3.0, 2.0 - 0.4]] * 2, atol=1e-12)
