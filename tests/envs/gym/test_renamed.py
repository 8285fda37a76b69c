"""Observation and goals under other names, of several entries, and with a mask that says what counts."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from torchrl_her import EnvReward, HERWriter
from torchrl_her_envs import GymGoalEnv, make_gym_env

CRANE = "tests/MaskedCrane-v0"  # episodes of 6 steps
NAMES: dict[str, Any] = {
    "observation_key": ["sensors", "mask"],
    "achieved_goal_key": ["hook", "angle"],
    "desired_goal_key": ["hook_to", "angle_to"],
}
MASKED = {**NAMES, "masked": True, "info_keys": ["mask"]}


class Crane(gymnasium.Env):
    """A hook in the plane and an angle; goals are both, or what a mask of three says counts.

    Args:
        masked: whether the mask counts, which info has.
    """

    def __init__(self, masked: bool = False) -> None:
        row, angle = spaces.Box(-10.0, 10.0, (2,), np.float64), spaces.Box(-10.0, 10.0, (1,), np.float64)
        hook = {"hook": row, "hook_to": row, "angle": angle, "angle_to": angle}
        mask = spaces.Box(0.0, 1.0, (3,), np.float64)
        self.observation_space = spaces.Dict(sensors=row, mask=mask, **hook)
        self.action_space = spaces.Box(-1.0, 1.0, (3,), np.float64)
        self.masked = masked

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]:
        super().reset(seed=seed)
        self.at, self.goal = self.np_random.uniform(-1.0, 1.0, (2, 3))
        self.mask = self.np_random.permutation([1.0, 0.0, 0.0])
        return self._show(), {"mask": self.mask}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.at = np.clip(self.at + action, -1.0, 1.0)
        shown, info = self._show(), {"mask": self.mask}
        goals = ({key: shown[key + end] for key in ("hook", "angle")} for end in ("", "_to"))
        achieved, desired = goals
        desired = {f"{key}_to": value for key, value in desired.items()}
        return shown, float(self.compute_reward(achieved, desired, info)), False, False, info

    def compute_reward(self, achieved: Any, desired: Any, info: Any) -> Any:
        gap = [abs(achieved[key] - desired[f"{key}_to"]) for key in ("hook", "angle")]
        counts = info["mask"] if self.masked else 1.0
        return -(np.concatenate(gap, -1) * counts > 0.5).any(-1).astype(np.float64)

    def _show(self) -> dict[str, Any]:
        shown = {"sensors": self.at[:2] / 2, "mask": self.mask}
        for end, own in (("", self.at), ("_to", self.goal)):
            shown |= {f"hook{end}": own[:2], f"angle{end}": own[2:]}
        return shown


gymnasium.register(CRANE, Crane, max_episode_steps=6)


def relabeled(env: GymGoalEnv) -> Any:
    torch.manual_seed(0)
    batch = env.rollout(60, break_when_any_done=False)
    writer = HERWriter(EnvReward.of(env), k=4, strategy="episode")
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(2_000), writer=writer)
    buffer.extend(batch)
    env.close()
    return buffer[:]


def test_several_entries_follow_each_other_in_the_order_given() -> None:
    env = make_gym_env(CRANE, num_envs=2, seed=1, **NAMES)
    rows = relabeled(env)
    after, virtual = rows["next"], rows["virtual"].flatten()
    assert rows["observation"].shape[1] == 5
    assert torch.equal(rows["observation"][:, :2], rows["achieved_goal"][:, :2] / 2)  # the hook comes first
    far = ((after["achieved_goal"] - after["desired_goal"]).abs() > 0.5).any(-1, keepdim=True)
    assert torch.equal(after["reward"], -far.float())
    assert (~far[virtual]).any()
    assert far[virtual].any()


def test_a_mask_in_info_says_what_of_a_virtual_goal_counts() -> None:
    env = make_gym_env(CRANE, num_envs=2, seed=1, **MASKED)
    rows = relabeled(env)
    after, virtual = rows["next"], rows["virtual"].flatten()
    mask = rows["observation"][:, 2:]  # which the policy sees
    assert torch.equal(mask.double(), rows["info", "mask"])
    assert torch.equal(mask.double(), after["info", "mask"])
    gap = (after["achieved_goal"] - after["desired_goal"]).abs()
    far = (gap * mask > 0.5).any(-1, keepdim=True)
    assert torch.equal(after["reward"], -far.float())
    only = ~far & (gap > 0.5).any(-1, keepdim=True)  # achieved, since the mask leaves out what is far
    assert only[virtual].any()


def test_one_entry_is_passed_on_as_it_is() -> None:
    names = {"observation_key": "sensors", "achieved_goal_key": "hook", "desired_goal_key": "hook_to"}
    gymnasium.register("tests/Hook-v0", Hook, max_episode_steps=6)
    env = make_gym_env("tests/Hook-v0", seed=1, **names)
    assert {key: own.shape[-1] for key, own in env.observation_spec.items()} == dict.fromkeys(
        ("observation", "achieved_goal", "desired_goal"), 2
    )
    reward = env.compute_reward(torch.tensor([[0.0, 1.0], [0.0, 0.0]]), torch.tensor([0.0, 0.25]))
    assert reward.tolist() == [[-1.0], [0.0]]
    env.close()
    del gymnasium.registry["tests/Hook-v0"]


class Hook(Crane):
    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.at = np.clip(self.at + action, -1.0, 1.0)
        return self._show(), float(self.compute_reward(self.at[:2], self.goal[:2], {})), False, False, {}

    def compute_reward(self, achieved: Any, desired: Any, info: Any) -> Any:
        return -(abs(achieved - desired) > 0.5).any(-1).astype(np.float64)


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ({"desired_goal_key": "hook_at"}, "'s observations must have 'hook_at', got sensors, .*"),
        ({"achieved_goal_key": ["hook", "angel"]}, "'s observations must have 'angel', got "),
        ({"desired_goal_key": ["hook_to"]}, "'s achieved and desired goals must have one shape"),
    ],
)
def test_names_that_are_wrong_are_told(names: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=f"^{CRANE} ?{message}"):
        make_gym_env(CRANE, **{**NAMES, **names})
