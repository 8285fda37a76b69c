"""Functions of goals, whatever they take."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from torchrl_her_envs.gym.goal_functions import GoalFunction, ShapedReward

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
    with pytest.raises(ValueError, match=r"Env-v0's reward reads info\['fallen'\], .*info_keys=\[fallen\]$"):
        GoalFunction(lambda a, d, info: info["fallen"], *MET, name="Env-v0's reward")
    with pytest.raises(
        ValueError, match="reward cannot be called with two goals and an empty info: TypeError"
    ):
        GoalFunction(lambda a, d, info: a + None, *MET, name="reward")
    with pytest.raises(ValueError, match=r"compute_reward must give one number .* of shape \(3,\)"):
        GoalFunction(lambda a, d, info: a - d, *MET, name="compute_reward")


@pytest.mark.parametrize(
    ("function", "form", "answers"),
    [
        (lambda a, d, info: -abs(a - d).sum(-1) - info["cost"], "pair", "batch"),
        (lambda a, d, info: -float(abs(a - d).sum()) - info["cost"], "pair", "loop"),
        (
            lambda a, d, info: [-abs(a[n] - d[n]).sum() - info["cost"][n] for n in range(len(a))],
            "rows",
            "batch",
        ),
        (
            lambda a, d, info: -abs(a - d).sum(1) - np.array([own["cost"] for own in info]),
            "rows and infos",
            "batch",
        ),
        (
            lambda a, d, info: (
                -abs(a - d).sum(-1)
                - (info["cost"] if isinstance(info, dict) and a.ndim == 1 else [own["cost"] for own in info])
            ),
            "pair",
            "batch",
        ),
    ],
)
def test_infos_come_in_the_form_that_a_function_takes(function: Any, form: str, answers: str) -> None:
    cost = np.array([0.5, 0.25, 2.0, 0.0])
    found = GoalFunction(function, *MET, name="compute_reward", info={"cost": cost})
    assert (found.form, found.answers, found.lacking) == (form, answers, set())
    assert found.tried.tolist() == [-9.5, -0.25, -2.0, 0.0]
    assert found(MET[0], MET[1], {"cost": cost[::-1]}).tolist() == [-9.0, -2.0, -0.25, -0.5]
    assert found(MET[0][:1], MET[1][:1], {"cost": cost[2:3]}).tolist() == [-11.0]


def test_keys_that_are_asked_for_in_vain_are_noticed() -> None:
    found = GoalFunction(
        lambda a, d, info: -abs(a - d).sum(-1) * info.get("wear", 1.0) - ("rain" in info), *MET, name="reward"
    )
    assert found.lacking == {"rain", "wear"}
    assert found.hint(["cost"]).endswith("task.options.info_keys=[cost,rain,wear]")
    rows = GoalFunction(
        lambda a, d, info: [0.0 if info[0] is None else -1.0] if a.ndim > 1 else 0.0, *MET, name=""
    )
    assert (rows.lacking, rows.hint([])) == (set(), "")


@pytest.mark.parametrize("dtype", [np.uint8, np.bool_, np.int8])
def test_shaped_rewards_are_the_same_for_goals_of_whole_numbers(dtype: type[np.generic]) -> None:
    def sparse(achieved: np.ndarray, desired: np.ndarray, info: Any) -> np.ndarray:
        return -(achieved != desired).any(-1).astype(float)

    shaped = ShapedReward(sparse, -1.0, 0.0, [1.0, 9.0])
    goals = np.array([[0], [1]]), np.array([[1], [0]])
    numbers = (goal.astype(np.float32) for goal in goals)
    assert shaped(*(goal.astype(dtype) for goal in goals)).tolist() == shaped(*numbers).tolist()
