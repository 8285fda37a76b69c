"""The environments under TorchRL's own tools."""

from __future__ import annotations

import pytest
import torch
from torchrl.collectors import Collector
from torchrl.envs import DoubleToFloat, RewardSum, StepCounter, TransformedEnv
from torchrl.envs.libs.gym import GymEnv
from torchrl.envs.utils import RandomPolicy, check_env_specs

from torchrl_her_envs import TASKS, base_env, make_env


@pytest.mark.parametrize("name", TASKS)
@pytest.mark.parametrize("num_envs", [1, 64])  # stepped as numbers, and as arrays
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_specs(name: str, num_envs: int, dtype: torch.dtype) -> None:
    env = make_env(name, num_envs=num_envs, dtype=dtype)
    check_env_specs(env, seed=0)
    steps = env.rollout(2, break_when_any_done=False)
    for key in ("state", "observation", "achieved_goal", "desired_goal", "action", ("next", "reward")):
        assert steps[key].dtype == dtype


def test_types_that_numpy_lacks() -> None:
    env = make_env("hand_v0", num_envs=5, dtype=torch.bfloat16)
    check_env_specs(env, seed=0)
    env.set_seed(0)
    torch.manual_seed(0)
    after = env.rollout(60, break_when_any_done=False)["next"]
    goals = after["achieved_goal"], after["desired_goal"]
    assert after["reward"].dtype == torch.bfloat16
    assert torch.equal(after["reward"], env.compute_reward(*goals))
    assert torch.equal(after["terminated"], env.compute_terminated(*goals))


@pytest.mark.parametrize("links", [1, 2, 3])
@pytest.mark.parametrize("name", ["robot_reach", "robot_v2"])
def test_specs_of_other_arms(name: str, links: int) -> None:
    check_env_specs(make_env(name, num_envs=2, num_links=links), seed=0)


def test_a_collector_gets_whole_episodes() -> None:
    torch.manual_seed(0)
    env = make_env("hand_v2", num_envs=4, seed=1)
    collector = Collector(
        env, RandomPolicy(env.full_action_spec), frames_per_batch=4 * 40, total_frames=4 * 120
    )
    batches = list(collector)
    collector.shutdown()
    steps = torch.cat(batches, 1)
    assert steps.batch_size == (4, 120)
    counts = steps["collector", "traj_ids"].flatten().unique(return_counts=True)[1]
    assert counts.max() == 50
    for world in steps:
        ids, done = world["collector", "traj_ids"].flatten(), world["next", "done"].flatten()
        assert torch.equal(ids[1:] != ids[:-1], done[:-1])


def test_transforms_go_around_it() -> None:
    torch.manual_seed(0)
    env = TransformedEnv(make_env("robot_v1", num_envs=3), StepCounter())
    check_env_specs(env, seed=0)
    env = env.append_transform(RewardSum())
    steps = env.rollout(60, break_when_any_done=False)
    after = steps["next"]
    assert torch.equal(after["step_count"] == 50, after["truncated"])
    assert torch.equal(after["episode_reward"][:, 9], after["reward"][:, :10].sum(1))


def test_the_environment_below_transforms_is_found() -> None:
    env = make_env("hand_reach")
    once = TransformedEnv(env, StepCounter())
    assert base_env(env) is env
    assert base_env(once) is env
    assert base_env(TransformedEnv(once, DoubleToFloat(), auto_unwrap=False)) is env


def test_there_must_be_a_throwing_environment() -> None:
    with pytest.raises(TypeError, match="expected a ThrowingEnv, transformed or not, got GymEnv"):
        base_env(GymEnv("CartPole-v1"))
