"""Toy environments of every kind, and what several of these tests do with them."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from hypothesis import strategies as st
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from torchrl_her import EnvReward, HERWriter
from torchrl_her_envs import BitFlip, Chain, ToyEnv, TreasureHunt

Make = Callable[..., ToyEnv]


ENVS: dict[str, Make] = {
    "bits": lambda **options: BitFlip(5, **options),
    "bits and a useless action": lambda **options: BitFlip(5, useless_action=True, **options),
    "treasure": lambda **options: TreasureHunt(10, **options),
    "chain": lambda **options: Chain(6, 0.7, **options),
    "chain that resets": lambda **options: Chain(6, 0.7, reset_state=True, **options),
    "chain of stages": lambda **options: Chain(6, 0.7, stages=2, alternating=True, **options),
}


every_env = pytest.mark.parametrize("make", ENVS.values(), ids=ENVS)


some_env = st.sampled_from(list(ENVS.values()))


SHOWN = ("state", "observation", "achieved_goal", "desired_goal")


def act(env: ToyEnv, *actions: int) -> TensorDictBase:
    """One step: the same action in all environments, or one for each."""
    action = torch.tensor(actions).expand(env.batch_size)
    return env.step(TensorDict({"action": action}, batch_size=env.batch_size))["next"]


def put(env: ToyEnv, **values: list[int] | list[list[int]]) -> None:
    state = env.world_state_dict()
    env.load_world_state_dict(
        state | {key: torch.tensor(value).expand_as(state[key]) for key, value in values.items()}
    )


def random_actions(env: ToyEnv, steps: int, *, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(env.num_actions, (steps, *env.batch_size), generator=generator)


def collect(env: ToyEnv, actions: Tensor) -> TensorDictBase:
    """[N, steps] transitions, with episodes that end and begin again, as a collector gets them."""
    steps, now = [], env.reset()
    for action in actions:
        step, now = env.step_and_maybe_reset(now.set("action", action))
        steps.append(step)
    return torch.stack(steps, 1)


def everything(rows: TensorDictBase) -> Tensor:
    keys = [*SHOWN, *(("next", key) for key in (*SHOWN, "reward", "terminated", "truncated", "done"))]
    return torch.cat([rows[key].float() for key in keys], -1)


def relabelled(env: ToyEnv, steps: TensorDictBase, **options: object) -> tuple[TensorDict, TensorDict]:
    """The real and the virtual rows."""
    rule = EnvReward.of(env)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(5000), writer=HERWriter(rule, k=4, **options), batch_size=32
    )
    buffer.set_rng(torch.Generator().manual_seed(0))
    buffer.extend(steps)
    rows = buffer[:]
    virtual = rows["virtual"].squeeze(-1)
    return rows[~virtual], rows[virtual]
