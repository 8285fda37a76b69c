"""Throwing environments whose episodes start where another one was at some step."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_her_envs import ThrowingEnv, make_controller, make_env
from torchrl_her_envs.throwing.env import base_env


def played(task: str, steps: int) -> tuple[list[dict[str, Tensor]], TensorDict]:
    """An expert's episodes in two environments: the state before each step, and the steps."""
    env = base_env(make_env(task, num_envs=2, seed=4))
    expert, states = make_controller(env), []

    def act(tensordict: TensorDict) -> TensorDict:
        states.append(env.world_state_dict())
        return expert(tensordict)

    return states, env.rollout(steps, act, break_when_any_done=False)


@pytest.mark.parametrize("num_envs", [3, 5])  # few are stepped one by one, more of them together
@pytest.mark.parametrize("task", ["hand_wall_v1", "robot_v1", "hand_reach"])
def test_what_follows_a_start_is_what_followed_there(task: str, num_envs: int) -> None:
    states, steps = played(task, 9)
    env = ThrowingEnv(base_env(make_env(task)).task, num_envs=num_envs, seed=0)
    env.reset()
    before = env.world_state_dict()
    at = {name: entry[1:] for name, entry in states[3].items()}
    shown = env.start_at(at, torch.tensor([2]))
    assert torch.equal(shown["desired_goal"][2], steps["desired_goal"][1, 3])
    assert env.worlds.step[2] == 0
    others = [k for k in range(num_envs) if k != 2]
    for name, own in env.world_state_dict().items():
        assert torch.equal(own[others], before[name][others]), name
    for t in range(3, 9):
        action = torch.zeros(num_envs, steps["action"].shape[-1])
        action[2] = steps["action"][1, t]
        after = env.step(TensorDict({"action": action}, [num_envs]))["next"]
        torch.testing.assert_close(after["state"][2], steps["next", "state"][1, t], rtol=0, atol=1e-6)
        if bool(steps["next", "done"][1, t]):
            break
    assert env.worlds.step[2] == t - 2
