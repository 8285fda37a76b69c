"""What all toy environments do: under TorchRL's tools, in batches, with seeds, resets and hindsight."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from torchrl_her import GoalReward
from torchrl_her_envs import BitFlip, Chain, ToyEnv, TreasureHunt

from .toy_envs import SHOWN, Make, act, collect, every_env, everything, random_actions, some_env


@every_env
@pytest.mark.parametrize("num_envs", [1, 3])
def test_specs(make: Make, num_envs: int) -> None:
    env = make(num_envs=num_envs)
    check_env_specs(env, seed=0)
    steps = env.rollout(2, break_when_any_done=False)
    for key in (*SHOWN, ("next", "reward")):
        assert steps[key].dtype == torch.float32
    assert torch.equal(steps["state"], torch.cat((steps["observation"], steps["desired_goal"]), -1))
    goals = steps["achieved_goal"].shape[-1]
    assert torch.equal(steps["observation"][..., -goals:], steps["achieved_goal"])


@every_env
def test_entries_do_not_share_memory(make: Make) -> None:
    shown = make(num_envs=2).reset()
    pointers = {shown[key].untyped_storage().data_ptr() for key in SHOWN}
    assert len(pointers) == len(SHOWN)


@settings(max_examples=15, deadline=None)
@given(some_env, st.integers(1, 6), st.integers(0, 2**64 - 1))
def test_a_batch_equals_single_environments_and_repeats(make: Make, num_envs: int, seed: int) -> None:
    many, more = make(num_envs=num_envs, seed=seed), make(num_envs=num_envs + 3, seed=seed)
    actions = random_actions(more, 20)
    seen = everything(collect(more, actions))
    assert torch.equal(everything(collect(many, actions[:, :num_envs])), seen[:num_envs])
    single = make(num_envs=1, seed=seed)
    assert torch.equal(everything(collect(single, actions[:, :1])), seen[:1])


@every_env
def test_seeds_give_equal_blocks_each_as_if_alone(make: Make) -> None:
    both = make(num_envs=6, seed=[3, 11])
    actions = random_actions(both, 25)
    seen = everything(collect(both, actions))
    for block, seed in ((slice(0, 3), 3), (slice(3, 6), 11)):
        alone = make(num_envs=3, seed=seed)
        assert torch.equal(everything(collect(alone, actions[:, block])), seen[block])


def test_environments_seeds_and_episodes_differ() -> None:
    starts = []
    for seed in (0, 1):
        env = BitFlip(40, num_envs=5, seed=seed)
        starts += [env.reset()["state"] for _ in range(3)]
    assert len(torch.cat(starts).unique(dim=0)) == 2 * 5 * 3


def test_starts_do_not_depend_on_how_long_episodes_are() -> None:
    short, long = TreasureHunt(num_envs=4, seed=1, max_steps=2), TreasureHunt(num_envs=4, seed=1)
    for _ in range(3):
        assert torch.equal(short.reset()["state"], long.reset()["state"])
        act(short, 0)


@settings(max_examples=15, deadline=None)
@given(some_env, st.lists(st.booleans(), min_size=5, max_size=5))
def test_a_partial_reset_leaves_the_other_environments_alone(make: Make, which: list[bool]) -> None:
    env, calm = make(num_envs=5), make(num_envs=5)
    mask = torch.tensor(which).unsqueeze(-1)
    env.reset()
    calm.reset()
    after = act(env, 1)
    act(calm, 1)
    before = env.world_state_dict()
    shown = env.reset(after.clone().set("_reset", mask))
    now, others = env.world_state_dict(), ~mask.squeeze(-1)
    assert all(torch.equal(now[key][others], before[key][others]) for key in now)
    assert all(torch.equal(shown[key][others], after[key][others]) for key in SHOWN)
    assert not shown["done"][~others].any()
    assert now["step"].tolist() == [0 if reset else 1 for reset in which]
    assert now["episode"].tolist() == [2 if reset else 1 for reset in which]
    for action in random_actions(env, 3):
        one, same = act(env, *action), act(calm, *action)
        assert all(torch.equal(one[key][others], same[key][others]) for key in SHOWN)


@every_env
def test_resuming_changes_nothing(make: Make) -> None:
    env, other = make(num_envs=4, seed=2), make(num_envs=4, seed=9)
    collect(env, random_actions(env, 9))
    other.reset()
    other.load_world_state_dict(env.world_state_dict())
    actions = random_actions(env, 20, seed=1)
    assert torch.equal(everything(collect(env, actions)), everything(collect(other, actions)))


@settings(max_examples=15, deadline=None)
@given(some_env, st.integers(0, 100))
def test_rewards_are_those_of_the_goals_reached(make: Make, seed: int) -> None:
    env = make(num_envs=6, seed=seed)
    after = collect(env, random_actions(env, 30, seed=seed))["next"]
    goals = after["achieved_goal"], after["desired_goal"]
    assert torch.equal(after["reward"], env.compute_reward(*goals))
    assert torch.equal(after["terminated"], env.compute_terminated(*goals))
    assert torch.equal(after["reward"] == 0, after["terminated"])
    assert torch.equal(after["terminated"], (goals[0] == goals[1]).all(-1, keepdim=True))
    assert torch.equal(after["done"], after["terminated"] | after["truncated"])
    reward, terminated = GoalReward(env.threshold)(*goals)
    assert torch.equal(reward, after["reward"])
    assert torch.equal(terminated, after["terminated"])


@pytest.mark.parametrize(
    "env", [TreasureHunt(), Chain(100, 0.5), BitFlip(100)], ids=["treasure", "chain", "bits"]
)
def test_neighbors_are_told_apart(env: ToyEnv) -> None:
    goal = env.goal_distribution.sample(1000).float()
    other = goal.clone()
    other[:, 0] -= torch.where(goal[:, 0] > 0, 2 * env.threshold, -2 * env.threshold)
    assert env.compute_terminated(goal, goal).all()
    assert not env.compute_terminated(goal, other).any()
    assert (env.compute_reward(goal, other) == -1).all()


def test_rewards_are_broadcast() -> None:
    env = BitFlip(2)
    achieved, desired = torch.zeros(4, 1, 2), torch.tensor([[0.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    reward = env.compute_reward(achieved, desired)
    assert reward.shape == (4, 3, 1)
    assert reward[3].flatten().tolist() == [0.0, -1.0, -1.0]


@every_env
def test_no_episode_starts_at_its_goal(make: Make) -> None:
    shown = make(num_envs=2000).reset()
    assert (shown["achieved_goal"] != shown["desired_goal"]).any(-1).all()


@pytest.mark.parametrize(
    ("action", "message"),
    [
        ([0, 3], "actions must be from 0 to 2, got 3 in environment 1"),
        ([-1, 0], "actions must be from 0 to 2, got -1 in environment 0"),
        ([[0], [1]], r"actions must be whole numbers of shape \[2\], got shape \[2, 1\] of torch.int64"),
        ([0.0, 1.0], r"actions must be whole numbers of shape \[2\], got shape \[2\] of torch.float32"),
    ],
)
def test_what_cannot_be_done(action: list[float], message: str) -> None:
    env = BitFlip(3, num_envs=2)
    env.reset()
    with pytest.raises(ValueError, match=message):
        env.step(TensorDict({"action": torch.tensor(action)}, batch_size=[2]))


def test_goals_of_another_width_are_refused() -> None:
    env = BitFlip(3)
    with pytest.raises(ValueError, match=r"goals must be of shape \[..., 3\], got \[7, 1\]"):
        env.compute_reward(torch.zeros(7, 3), torch.zeros(7, 1))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: BitFlip(3, max_steps=0), "max_steps must be a whole number from 1 to 1048575, got 0"),
        (lambda: BitFlip(3, num_envs=0), "num_envs must be a whole number at least 1, got 0"),
        (lambda: BitFlip(3, num_envs=5, seed=[1, 2]), "5 environments cannot be shared out among 2 seeds"),
        (lambda: BitFlip(3, seed=[]), "1 environments cannot be shared out among 0 seeds"),
        (lambda: BitFlip(3, seed=-1), r"a seed must be at least 0 and below 2\*\*64, got -1"),
    ],
)
def test_what_cannot_be_made(make: Callable[[], ToyEnv], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()
