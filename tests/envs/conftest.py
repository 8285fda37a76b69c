"""What several of these files need: environments put into a known state, and actions as plain lists."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict, TensorDictBase

from torchrl_her_envs import ThrowingEnv

Put = Callable[..., None]
Act = Callable[..., TensorDictBase]


@pytest.fixture(autouse=True, scope="session")
def _one_thread() -> None:
    torch.set_num_threads(1)  # tensors this small are slower with more


@pytest.fixture
def put() -> Put:
    """``put(env, ball=[1.0, 2.0], held=True)`` writes over fields of all environments; lengths are in meters.

    ``joints`` brings the grip along, as the effector would.
    """

    def write(env: ThrowingEnv, **values: object) -> None:
        state = env.world_state_dict()
        for name, value in values.items():
            state[name][:] = torch.as_tensor(value, dtype=state[name].dtype)
        if "joints" in values:
            state["grip"] = env.effector.grip(state["joints"])
        env.load_world_state_dict(state)

    return write


@pytest.fixture
def act() -> Act:
    """``act(env, [1.0, 0.0, -1.0])`` takes one step with this action everywhere, and returns ``next``.

    With one action for each environment, ``act(env, [...], [...])``, each takes its own.
    """

    def step(env: ThrowingEnv, *actions: list[float]) -> TensorDictBase:
        action = torch.tensor(actions, dtype=env.action_spec.dtype).expand(env.action_spec.shape)
        return env.step(TensorDict({"action": action}, batch_size=env.batch_size))["next"]

    return step
