"""The rules on arrays, as gymnasium's environments use them."""

from __future__ import annotations

import numpy as np
import pytest

from torchrl_her_envs import get_task
from torchrl_her_envs.throwing.core import ThrowingCore


def make(task: str = "hand_v1", num_envs: int = 5, **options: object) -> ThrowingCore:
    core = ThrowingCore(get_task(task), num_envs, **options)
    core.set_seeds([0])
    core.begin(np.arange(num_envs))
    return core


@pytest.mark.parametrize("num_envs", [1, 5])
def test_what_was_shown_is_not_changed_by_later_steps(num_envs: int) -> None:
    core, kept = make("hand_v2", num_envs), []
    rng = np.random.default_rng(0)
    for _ in range(10):
        core.advance(rng.uniform(-1, 1, (num_envs, 3)))
        shown = core.show()
        kept.append((shown, [own.copy() for own in shown]))
    core.begin(np.arange(num_envs))
    for shown, copies in kept:
        assert all(np.array_equal(own, copy) for own, copy in zip(shown, copies, strict=True))
        assert not any(
            np.shares_memory(one, other) for k, one in enumerate(shown) for other in shown[k + 1 :]
        )


def test_worlds_share_memory_with_the_steps() -> None:
    core = make()
    before = core.worlds.grip.clone()
    core.advance(np.full((5, 3), 0.5))
    assert (core.worlds.grip != before).any()
    core.worlds.ball[2] = core.worlds.ball.new_tensor([3.0, 3.0])
    core.worlds.closed[2] = True
    assert core.show().achieved_goal[2].tolist() == [0.0, 0.0]
    assert core.show().observation[2, 4] == 1.0


@pytest.mark.parametrize("num_envs", [1, 5])
@pytest.mark.parametrize(
    ("action", "message"),
    [
        ([0.0, np.nan, 0.0], r"actions must be finite, got \[0.0, nan, 0.0\] in environment"),
        ([0.0, 0.0, np.inf], r"actions must be finite, got \[0.0, 0.0, inf\] in environment"),
        ([0.0, 0.0], r"actions must be of shape \[\d, 3\], got \[\d, 2\]"),
    ],
)
def test_actions_that_cannot_be_move_nothing(num_envs: int, action: list[float], message: str) -> None:
    core = make(num_envs=num_envs)
    before = core.show().state
    actions = np.full((num_envs, len(action)), 0.5)
    actions[-1] = action
    with pytest.raises(ValueError, match=message):
        core.advance(actions)
    assert np.array_equal(core.show().state, before)
    assert not core.worlds.step.any()
