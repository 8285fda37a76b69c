"""Recording of demonstrations: plays episodes with a given policy."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_her.demonstrations.dataset import Demonstrations
from torchrl_her.trainers.trainer import evaluate

_COUNTED = ("key", "step", "episode")  # left out: counters and random keys are no physical state


def demonstrate(
    env: EnvBase,
    policy: Callable[[TensorDictBase], TensorDictBase],
    *,
    max_steps: int,
    achieved_reward: float = 0.0,
    **facts: Any,
) -> Demonstrations:
    """Plays the next episode of each environment with a policy, without exploration.

    The demonstrations include physical states if the environment below the transforms has a method
    ``world_state_dict``, which returns tensors with a row for each environment.

    Args:
        env: batch of N environments.
        policy: sets the action in the TensorDict of a step.

    Keyword Args:
        max_steps: maximum number of steps of an episode; a longer episode is truncated.
        achieved_reward: the reward of an achieved goal.
        **facts: ``task`` and ``made_by`` of :class:`~torchrl_her.demonstrations.Demonstrations`.

    Example:
        >>> from torchrl_her_envs import make_controller, make_env
        >>> env = make_env("hand_v0", num_envs=3, seed=0)
        >>> demos = demonstrate(env, make_controller(env), max_steps=50, task="hand_v0")
        >>> len(demos), sorted(demos.states)[:3]
        (3, ['ball', 'ball_velocity', 'closed'])
    """
    with_states: Any = env
    while with_states is not None and not callable(getattr(type(with_states), "world_state_dict", None)):
        with_states = getattr(with_states, "base_env", None)
    states: list[dict[str, Tensor]] = []

    def act(tensordict: TensorDictBase) -> TensorDictBase:
        if with_states is not None:
            states.append(with_states.world_state_dict())
        return policy(tensordict)

    rollout = evaluate(env, act, max_steps=max_steps)
    names = [name for name in (states[0] if states else {}) if name not in _COUNTED]
    stacked = {name: torch.stack([state[name] for state in states], 1) for name in names}
    return Demonstrations.from_rollout(
        rollout, first=True, states=stacked or None, achieved_reward=achieved_reward, **facts
    )
