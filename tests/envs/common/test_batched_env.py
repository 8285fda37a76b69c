"""What the base class makes of an environment that says only what is its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import Categorical, Unbounded
from torchrl.envs import EnvBase
from torchrl.envs.utils import check_env_specs

from torchrl_her_envs import BatchedEnv
from torchrl_her_envs.common.seeding import uniform


@dataclass
class Counters:
    value: Tensor
    goal: Tensor
    step: Tensor
    episode: Tensor


class Counting(BatchedEnv):
    """Action 1 counts up, 0 does nothing, 2 gives up; the goal is a number from 1 to 3."""

    def __init__(
        self, num_envs: int = 1, seed: Sequence[int] = (0,), dtype: torch.dtype = torch.float32
    ) -> None:
        super().__init__(num_envs)
        self.max_steps, self.dtype_shown = 4, dtype
        self.worlds = Counters(*(torch.zeros(num_envs, dtype=torch.int64) for _ in range(4)))
        self._make_specs(
            1,
            1,
            seen=partial(Unbounded, dtype=dtype),
            action=Categorical(n=3, shape=(num_envs,), dtype=torch.int64),
        )
        self.set_seeds(seed)
        self.started: list[list[int]] = []

    def compute_terminated(self, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
        return (achieved_goal == desired_goal).all(-1, keepdim=True)

    def _start_episodes(self, which: Tensor) -> None:
        self.started.append(which.tolist())
        self.worlds.value[which] = 0
        u = uniform(self._keys[which.numpy()], self.worlds.episode[which], 1).squeeze(-1)
        self.worlds.goal[which] = 1 + (u * 3).long()

    def _advance(self, action: Tensor) -> Tensor | None:
        self.worlds.value = self.worlds.value + (action == 1)
        return action == 2

    def _check_action(self, action: Tensor) -> None:
        if (action > 2).any():
            raise ValueError("no such action")

    def _show(self) -> dict[str, Tensor]:
        value, goal = (
            entry.unsqueeze(-1).to(self.dtype_shown) for entry in (self.worlds.value, self.worlds.goal)
        )
        state = torch.cat((value, goal), -1)
        return {"state": state, "observation": value, "achieved_goal": value.clone(), "desired_goal": goal}


def act(env: Counting, *actions: int) -> TensorDict:
    return env.step(TensorDict({"action": torch.tensor(actions)}, env.batch_size))["next"]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("num_envs", [1, 3])
def test_specs(num_envs: int, dtype: torch.dtype) -> None:
    env = Counting(num_envs, dtype=dtype)
    check_env_specs(env, seed=0)
    steps = env.rollout(2, break_when_any_done=False)
    assert {steps[key].dtype for key in ("state", "desired_goal", ("next", "reward"))} == {dtype}


def test_ends_and_rewards() -> None:
    env = Counting(3)
    env.reset()
    env.worlds.goal[:] = torch.tensor([1, 2, 3])
    after = act(env, 1, 1, 2)
    assert after["terminated"].flatten().tolist() == [True, False, False]
    assert after["truncated"].flatten().tolist() == [False, False, True]  # gave up
    assert after["done"].flatten().tolist() == [True, False, True]
    assert after["reward"].flatten().tolist() == [0.0, -1.0, -1.0]
    for _ in range(3):
        after = act(env, 0, 0, 0)
    assert after["truncated"].all()  # out of time
    assert env.worlds.step.tolist() == [4] * 3


def test_a_reset_with_a_mask_starts_those_alone() -> None:
    env = Counting(4, seed=(3,))
    shown = env.reset()
    after = act(env, 1, 1, 1, 1)
    mask = torch.tensor([[True], [False], [True], [False]])
    shown = env.reset(after.clone().set("_reset", mask))
    assert env.started == [[0, 1, 2, 3], [0, 2]]
    assert shown["observation"].flatten().tolist() == [0.0, 1.0, 0.0, 1.0]
    assert env.worlds.step.tolist() == [0, 1, 0, 1]
    assert env.worlds.episode.tolist() == [2, 1, 2, 1]
    assert not shown["done"][mask].any()


def test_maybe_reset_gives_what_torchrls_own_gives() -> None:
    ours, theirs = Counting(4, seed=(3,)), Counting(4, seed=(3,))
    outs = []
    for env, maybe_reset in ((ours, ours.maybe_reset), (theirs, partial(EnvBase.maybe_reset, theirs))):
        env.reset()
        act(env, 1, 1, 1, 0)
        after = act(env, 1, 2, 0, 2).exclude("reward")
        after.update({"action": torch.arange(4) + 1, "memory": TensorDict({"hidden": torch.ones(4, 3)}, [4])})
        outs.append(maybe_reset(after))
    mine, other = outs
    assert set(mine.keys(True, True)) == set(other.keys(True, True))
    for key in mine.keys(True, True):
        assert torch.equal(mine[key], other[key]), key
    assert mine["action"].tolist().count(0) >= 2  # those that gave up
    assert not mine["done"].any()
    assert (ours.started, ours.worlds.step.tolist()) == (theirs.started, theirs.worlds.step.tolist())


def test_maybe_reset_leaves_what_it_was_given() -> None:
    env = Counting(3)
    env.reset()
    env.worlds.goal[:] = 3
    after = act(env, 2, 1, 1)
    kept = after.clone()
    begun = env.maybe_reset(after)
    assert (after == kept).all()
    assert begun["observation"].flatten().tolist() == [0.0, 1.0, 1.0]


def test_maybe_reset_does_nothing_before_an_end() -> None:
    env = Counting(2)
    env.reset()
    env.worlds.goal[:] = 3
    after = act(env, 1, 0)
    assert env.maybe_reset(after) is after
    assert env.started == [[0, 1]]


def test_resuming_and_seeding() -> None:
    env, other = Counting(6, seed=(3, 5)), Counting(6, seed=(9,))
    env.reset()
    act(env, 1, 0, 1, 0, 1, 0)
    state = env.world_state_dict()
    kept = {key: value.clone() for key, value in state.items()}
    other.load_world_state_dict(state)
    assert torch.equal(env.reset()["state"], other.reset()["state"])
    assert all(torch.equal(kept[key], state[key]) for key in kept)
    env.set_seed(5)
    assert torch.equal(env.reset()["state"][:3], Counting(3, seed=(5,)).reset()["state"])
    with pytest.raises(ValueError, match="6 environments cannot be shared out among 4 seeds"):
        env.set_seeds([1, 2, 3, 4])


def test_actions_are_checked_before_anything_moves() -> None:
    env = Counting(2)
    env.reset()
    with pytest.raises(ValueError, match="no such action"):
        act(env, 1, 3)
    assert env.worlds.step.tolist() == [0, 0]


def test_what_a_subclass_must_say() -> None:
    class Empty(BatchedEnv):
        pass

    with pytest.raises(TypeError, match="abstract"):
        Empty(1)


def test_episodes_start_at_given_states_and_the_others_go_on() -> None:
    env, untouched = Counting(3), Counting(3)
    for each in (env, untouched):
        each.reset()
        each.worlds.goal[:] = 3
        act(each, 1, 1, 1)
    shown = env.start_at({"value": torch.tensor([2, 0]), "goal": torch.tensor([3, 1])}, torch.tensor([2, 0]))
    assert shown["state"].tolist() == [[0.0, 1.0], [1.0, 3.0], [2.0, 3.0]]
    assert env.worlds.step.tolist() == [0, 1, 0]
    assert env.worlds.episode.tolist() == [1, 1, 1]
    assert act(env, 1, 1, 1)["terminated"].flatten().tolist() == [True, False, True]
    assert torch.equal(env.reset()["state"], untouched.reset()["state"])  # the same draws follow


@pytest.mark.parametrize(
    ("states", "which", "message"),
    [
        ({"value": torch.zeros(1)}, [0], "the states of Counting lack 'goal', got value"),
        (
            {"value": torch.zeros(2), "goal": torch.zeros(1)},
            [0],
            r"'value' of the states must be of shape \[1\], got \[2\]",
        ),
        (
            {"value": torch.zeros(2), "goal": torch.zeros(2)},
            [1, 1],
            r"distinct indices from 0 to 1, got \[1, 1\]",
        ),
        (
            {"value": torch.zeros(1), "goal": torch.zeros(1)},
            [2],
            r"distinct indices from 0 to 1, got \[2\]",
        ),
    ],
)
def test_states_that_cannot_be_started_at(states: dict[str, Tensor], which: list[int], message: str) -> None:
    env = Counting(2)
    env.reset()
    before = env.world_state_dict()
    with pytest.raises(ValueError, match=message):
        env.start_at(states, torch.tensor(which))
    assert all(torch.equal(own, env.world_state_dict()[name]) for name, own in before.items())
