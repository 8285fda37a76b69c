"""Functions of goals, whatever they take."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from torchrl_her_envs.gym.goal_functions import GoalFunction

MET = np.zeros((4, 3)), np.array([[9.0, 0.0, 0.0], [0.0] * 3, [0.0] * 3, [0.0] * 3])


@pytest.mark.parametrize(
    ("function", "answers"),
    [
        (lambda a, d, info: -np.linalg.norm(a - d, axis=-1), "batch"),
        (lambda a, d, info: -np.linalg.norm(a - d, axis=-1, keepdims=True), "batch"),
        (lambda a, d, info: np.linalg.norm(a - d) < 1, "loop"),  # of all of a batch
        (lambda a, d, info: np.array_equal(a, d), "loop"),
        (lambda a, d, info: -abs(a - d).sum(0) if a.ndim > 1 else -abs(a - d).sum(), "loop"),  # the wrong way
        (lambda a, d, info: float(a[0] == d[0]), "loop"),  # fails with batches
        (lambda a, d, info: False, "one"),
        (lambda a, d, info: np.array([0.0]), "one"),
    ],
)
def test_what_a_function_takes_is_found_out(function: Any, answers: str) -> None:
    found = GoalFunction(function, *MET, name="compute_reward")
    assert found.answers == answers
    alone = [float(np.asarray(function(a, d, {})).item()) for a, d in zip(*MET, strict=True)]
    assert found(*MET).tolist() == alone
    assert found(MET[0][:1], MET[1][:1]).tolist() == alone[:1]


@pytest.mark.parametrize(
    ("function", "form"),
    [
        (lambda a, d, info: -np.linalg.norm(a - d, axis=1), "rows"),
        (lambda a, d, info: [-abs(a[n] - d[n]).sum() for n in range(a.shape[0])], "rows"),
        (
            lambda a, d, info: [-abs(x - y).sum() for x, y, _ in zip(a, d, info, strict=True)],
            "rows and infos",
        ),
        (lambda a, d, info: -abs(a - d).sum(-1), "pair"),
    ],
)
def test_functions_may_take_batches_alone(function: Any, form: str) -> None:
    found = GoalFunction(function, *MET, name="compute_reward")
    assert (found.form, found.answers) == (form, "batch")
    assert found(*MET).tolist() == [-9.0, 0.0, 0.0, 0.0]
    assert found(MET[0][:1], MET[1][:1]).tolist() == [-9.0]
    assert found(MET[0][:0], MET[1][:0]).tolist() == []


def test_functions_that_need_an_info_or_give_no_number_are_refused() -> None:
    with pytest.raises(
        ValueError, match="Env-v0's compute_terminated cannot be called .* KeyError: 'fallen'"
    ):
        GoalFunction(lambda a, d, info: info["fallen"], *MET, name="Env-v0's compute_terminated")
    with pytest.raises(ValueError, match=r"compute_reward must give one number .* of shape \(3,\)"):
        GoalFunction(lambda a, d, info: a - d, *MET, name="compute_reward")
