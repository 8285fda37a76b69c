"""What ends without the goal are worth: in environments, buffers and evaluations."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from tensordict.nn import TensorDictModule

from torchrl_her_recipes import build, make_recipe
from torchrl_her_recipes.components.envs import TaskEnvs
from torchrl_her_recipes.runs.evaluation import measure

from ...envs.gym.walk import Plain

TASK = "gym:tests/Cliff-v0"
GAMMA = 0.9
WORTH = -10.0  # -1 / (1 - GAMMA)
OPTIONS: dict[str, Any] = {
    "gamma": GAMMA,
    "algo": "her",
    "hidden": 8,
    "num_envs": 2,
    "epoch_frames": 40,
    "warmup_frames": 0,
    "episodes": 2,
    "sampler": "uniform",
    "normalize": False,
}


class Cliff(Plain):
    """A walk from place 2 to goal 4; in place 0 it falls, where goal and cliff are apart.

    Args:
        crash: the reward of a fall.
        stops: whether the goal ends an episode.
    """

    def __init__(self, *, crash: float = -1.0, stops: bool = True) -> None:
        super().__init__(falls=True, stops=stops)
        self.action_space = spaces.Box(-2.0, 2.0, (1,), np.float32)
        self.crash = crash

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        shown, reward, *rest = super().step(action)
        return shown, self.crash if self.place == 0.0 else reward, *rest

    def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, info: Any) -> Any:
        return (np.abs(achieved - desired)[..., 0] < 0.5) - 1.0


gymnasium.register("tests/Cliff-v0", Cliff, max_episode_steps=12)


def walked(steps: list[float], **options: Any) -> Any:
    """What a walk of one environment showed, [T]."""
    recipe = make_recipe(task=TASK, **{**OPTIONS, **options})
    env = TaskEnvs.of(recipe).make(1, [0])
    seen = env.reset()
    rows = []
    for step in steps:
        stepped, seen = env.step_and_maybe_reset(seen.set("action", torch.tensor([[step]])))
        rows.append(stepped["next"])
    return torch.stack(rows, 1)[0]


@pytest.mark.parametrize(
    ("failure", "crash", "reward", "terminated"),
    [
        ("never_pays", -1.0, WORTH, True),
        ("never_pays", -100.0, WORTH, True),
        ("never_pays", 0.0, WORTH, True),  # a fall is no success, whatever it gives
        ("environment", -100.0, -100.0, True),
        ("truncate", -1.0, -1.0, False),
    ],
)
def test_a_fall_is_worth_what_the_option_says(
    failure: str, crash: float, reward: float, terminated: bool
) -> None:
    after = walked([-1.0, -1.0, 1.0], failure=failure, **{"task.options": {"crash": crash}})
    assert after["reward"].flatten().tolist() == pytest.approx([-1.0, reward, -1.0])
    assert after["terminated"].flatten().tolist() == [False, terminated, False]
    assert after["truncated"].flatten().tolist() == [False, not terminated, False]
    assert after["done"].flatten().tolist() == [False, True, False]


def test_an_achieved_goal_is_no_failure() -> None:
    after = walked([1.0, 1.0], **{"task.options": {"termination": "success"}})
    assert after["reward"].flatten().tolist() == [-1.0, 0.0]
    assert after["terminated"].flatten().tolist() == [False, True]
    after = walked([1.0, 1.0], **{"task.options": {"termination": "never"}})
    assert after["reward"].flatten().tolist() == [-1.0, 0.0]
    assert after["truncated"].flatten().tolist() == [False, True]


def test_tasks_of_this_package_have_no_failures() -> None:
    assert type(TaskEnvs.of(make_recipe(task="hand_v0")).make(1, [0])).__name__ == "ThrowingEnv"
    with pytest.raises(ValueError, match="failure=truncate has no effect with task=hand_v0"):
        make_recipe(task="hand_v0", failure="truncate")


def rows_after_falls(**options: Any) -> Any:
    """What a buffer has of some random episodes: the rewards of rows that ended by a fall."""
    components = build(make_recipe(task=TASK, **{**OPTIONS, "num_envs": 8, "epoch_frames": 80, **options}))
    for _, batch in zip(range(15), components.collector, strict=False):
        components.buffer.extend(batch)
    rows = components.buffer[:]
    components.close()
    return rows[(rows["next", "observation"] == 0).squeeze(-1)]


def test_it_costs_as_much_for_virtual_goals() -> None:
    fell = rows_after_falls()
    virtual = (fell["desired_goal"] != 4.0).squeeze(-1)
    met = (fell["desired_goal"] == 0.0).squeeze(-1)
    assert virtual.unique().tolist() == [False, True]
    assert met.any()
    assert fell["next", "terminated"].all()
    assert fell["next", "reward"][~met].unique().tolist() == pytest.approx([WORTH])
    assert fell["next", "reward"][met].unique().tolist() == pytest.approx([WORTH + 1.0])


def test_rows_over_several_steps_end_in_the_same_worth() -> None:
    """However many steps before a fall a row begins: never achieving the goal is worth the same from all."""
    fell = rows_after_falls(n_steps=3)
    missed = (fell["desired_goal"] == 4.0).squeeze(-1)
    steps = fell["steps_to_next_obs"][missed].unique().tolist()
    assert len(steps) > 1
    assert fell["next", "reward"][missed].flatten().tolist() == pytest.approx([WORTH] * int(missed.sum()))


def test_targets_are_clamped_to_it_and_returns_have_it() -> None:
    components = build(make_recipe(task=TASK, **OPTIONS))
    assert components.bounds == (-1.0, 0.0)  # of rewards; values are from WORTH on
    leftwards = TensorDictModule(lambda seen: -torch.ones_like(seen), ["observation"], ["action"])
    left = components.eval_env.rollout(12, leftwards, break_when_any_done=False)
    measured = measure(components, left)
    assert measured["success"].item() == 0.0
    assert measured["return"].item() == pytest.approx(WORTH)
    components.close()


def test_goals_that_are_proposed_do_not_make_a_fall_pay() -> None:
    fell = rows_after_falls(algo="no_hindsight", behavior="uniform_achieved", real_share=0.0)
    met = (fell["desired_goal"] == 0.0).squeeze(-1)
    proposed = (fell["desired_goal"] != 4.0).squeeze(-1) & ~met
    assert proposed.any()
    assert fell["next", "reward"][proposed].unique().tolist() == pytest.approx([WORTH])
