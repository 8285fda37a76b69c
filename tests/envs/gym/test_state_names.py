"""Entries of nested dictionaries can be named by the stages of a curriculum."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces

from torchrl_her_envs import make_gym_env

from .walk import ROW, WALK

NESTED = "tests/NestedWalk-v0"


class Nested(gymnasium.ObservationWrapper):
    """Shows the place as one of two entries of a dictionary."""

    def __init__(self, env: gymnasium.Env) -> None:
        super().__init__(env)
        inside = spaces.Dict(walker=spaces.Dict(place=ROW), age=spaces.Box(0.0, 9.0, (2,), np.float64))
        self.observation_space = spaces.Dict({**env.observation_space, "observation": inside})

    def observation(self, shown: dict[str, np.ndarray]) -> dict[str, Any]:
        return shown | {
            "observation": {"walker": {"place": shown["observation"]}, "age": np.array([3.0, 5.0])}
        }


def test_keys_name_the_entries_of_a_nested_observation() -> None:
    gymnasium.register(
        NESTED, lambda **options: Nested(gymnasium.make(WALK, **options).unwrapped), max_episode_steps=6
    )
    env = make_gym_env(NESTED, num_envs=2)
    names = env.state_names()
    assert names == {
        "observation": [0, 1, 2],
        "observation.age": [0, 1],
        "observation.walker.place": [2],
        "desired_goal": [3],
    }
    shown = env.reset()
    state = torch.cat((shown["observation"], shown["desired_goal"]), -1)
    assert torch.equal(state[:, names["observation.walker.place"]], shown["achieved_goal"])
    assert state[:, names["observation.age"]].tolist() == [[3.0, 5.0]] * 2
    assert make_gym_env(WALK).state_names() == {"observation": [0], "desired_goal": [1]}
