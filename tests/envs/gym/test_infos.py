"""Entries of info that rewards read: recorded, and given to virtual transitions of the same step."""

from __future__ import annotations

import logging
import re
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs.utils import check_env_specs

from torchrl_her import EnvReward, HERWriter
from torchrl_her_envs import GymGoalEnv, make_gym_env
from torchrl_her_envs.gym.infos import Infos

from .costly import COSTLY


def make_costly(num_envs: int = 2, **options: Any) -> GymGoalEnv:
    options = {"info_keys": ["cost"], "achieved_reward": -0.5, **options}
    return make_gym_env(COSTLY, num_envs=num_envs, seed=3, **options)


def by_hand(rows: TensorDictBase) -> Tensor:
    """What the environment gives for a step: -1 beyond 0.5 of the goal, and a quarter of the action."""
    after = rows["next"]
    far = (after["achieved_goal"] - after["desired_goal"]).abs() > 0.5
    return -far.float() - rows["action"].abs() / 4


@pytest.mark.parametrize(
    ("form", "answers"), [("one", "loop"), ("arrays", "batch"), ("infos", "batch"), ("maybe", "batch")]
)
def test_virtual_transitions_get_the_reward_that_the_environment_gives(form: str, answers: str) -> None:
    env = make_costly(form=form)
    check_env_specs(env)
    assert env._reward_of.answers == answers
    assert env.info_keys == [("info", "cost")]
    torch.manual_seed(0)
    batch = env.rollout(60, break_when_any_done=False)
    writer = HERWriter(EnvReward.of(env), k=4, filter_achieved=True)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(1_000), writer=writer)
    buffer.extend(batch)
    rows = buffer[:]
    virtual = rows["virtual"].flatten()
    assert 200 < int(virtual.sum()) <= 4 * 120
    torch.testing.assert_close(rows["next", "reward"], by_hand(rows))
    assert len(rows["next", "reward"][virtual].unique()) > 50
    assert (rows["next", "reward"][virtual] > -0.5).any()
    env.close()


def test_infos_of_the_step_before_are_in_the_root() -> None:
    env = make_costly()
    steps = env.rollout(12, break_when_any_done=False)
    cost, before = steps["next", "info", "cost"], steps["info", "cost"]
    assert cost.shape == (2, 12, 1)
    torch.testing.assert_close(cost, steps["action"].abs().double() / 4)
    assert torch.equal(before[:, 1:6], cost[:, :5])
    assert before[:, 6].eq(0).all()  # after a reset
    env.close()


def test_a_reward_that_reads_an_info_that_nobody_named_is_said(caplog: pytest.LogCaptureFixture) -> None:
    reads = (
        "tests/InfoCost-v0's compute_reward reads info['cost'], which virtual transitions have only if it is "
        "named: task.options.info_keys=[cost]"
    )
    with pytest.raises(ValueError, match=f"^{re.escape(reads)}$"):
        make_gym_env(COSTLY)
    with caplog.at_level(logging.WARNING, "torchrl_her_envs"):
        make_gym_env(COSTLY, form="maybe").close()
    assert [record.getMessage() for record in caplog.records] == [reads]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"info_keys": "cost"}, r"info_keys must be a list of keys of info, as in \[cost\], got 'cost'"),
        ({"info_keys": ["cost", "wind"]}, "tests/InfoCost-v0: info_keys names 'wind', .* it has cost"),
        ({"cost": "dear"}, r"tests/InfoCost-v0: info\['cost'\] must be a number, .* got 'dear'"),
        ({"achieved_reward": None}, "tests/InfoCost-v0 has a dense reward: .*"),
    ],
)
def test_what_cannot_be_is_named(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=f"^{message}"):
        make_costly(**options)


def test_a_step_that_lacks_an_entry_is_refused() -> None:
    env = make_costly(lacks_from=250)  # more than are tried before
    with pytest.raises(ValueError, match="info_keys names 'cost', which the info of a step lacks; it has"):
        env.rollout(260, break_when_any_done=False)
    env.close()


def test_a_reward_that_reads_info_is_asked_with_it() -> None:
    env, goals = make_costly(), torch.zeros(2, 1)
    with pytest.raises(ValueError, match=r"EnvReward\.of\(env\)"):
        env.compute_reward(goals, goals)
    env.close()


def test_entries_keep_their_shape_and_type() -> None:
    seen = [
        {"lamp": True, "mask": np.array([1, 0], np.uint8), "x": 1},
        {"lamp": False, "mask": [0, 1], "x": 0.5},
    ]
    infos = Infos(["lamp", "mask", "x"], seen, "walk")
    spec = infos.spec(3)
    shapes = {key: (list(own.shape), own.dtype) for key, own in spec.items()}
    assert shapes == {
        "lamp": ([3, 1], torch.bool),
        "mask": ([3, 2], torch.int64),
        "x": ([3, 1], torch.float64),
    }
    rows = infos.rows(infos.stack(seen))
    assert rows["mask"].tolist() == [[1, 0], [0, 1]]
    assert rows["x"].tolist() == [[1.0], [0.5]]
    with pytest.raises(ValueError, match=r"walk: info\['x'\] must be a number, or an array"):
        Infos(["x"], [{"x": [1.0]}, {"x": [1.0, 2.0]}], "walk")
