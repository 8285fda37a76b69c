"""Support for gymnasium environments whose observation and goals have other names, or several entries."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

import gymnasium
from gymnasium import spaces

if TYPE_CHECKING:
    from torchrl_her_envs.common.goal_env import Names


class RenamedKeys(gymnasium.ObservationWrapper):
    """Shows entries of an environment as ``observation``, ``achieved_goal`` and ``desired_goal``.

    Several entries become a dictionary in the order given. The environment's functions get goals in the
    environment's own form: one entry as it is, several as a dictionary under their own names.

    Args:
        env: environment whose observations are a dictionary.
        names: the environment's entry, or entries, for each of the three keys.

    Raises:
        ValueError: the environment has no such entry.
    """

    def __init__(self, env: gymnasium.Env, names: Mapping[str, Names]) -> None:
        super().__init__(env)
        self._names = names
        known = list(env.observation_space) if isinstance(env.observation_space, spaces.Dict) else []
        for sources in names.values():
            for name in [sources] if isinstance(sources, str) else sources:
                if name not in known:
                    env.close()
                    id = env.spec.id if env.spec else type(env).__name__
                    got = ", ".join(known) or "no dict"
                    raise ValueError(f"{id}'s observations must have {name!r}, got {got}")
        entries = self.observation(env.observation_space)
        inner = {
            key: spaces.Dict(entry) if isinstance(entry, dict) else entry for key, entry in entries.items()
        }
        self.observation_space = spaces.Dict(inner)
        for method in ("compute_reward", "compute_terminated", "_is_success"):
            if env.has_wrapper_attr(method):
                setattr(self, method, partial(self._ask, env.get_wrapper_attr(method)))

    def observation(self, observation: Any) -> dict[str, Any]:
        return {
            key: observation[names]
            if isinstance(names, str)
            else {f"{place:03}": observation[name] for place, name in enumerate(names)}
            for key, names in self._names.items()
        }

    def _ask(self, function: Any, achieved: Any, desired: Any, *info: Any) -> Any:
        return function(self._named("achieved_goal", achieved), self._named("desired_goal", desired), *info)

    def _named(self, key: str, goal: Any) -> Any:
        names = self._names[key]
        return goal if isinstance(names, str) else dict(zip(names, goal.values(), strict=True))
