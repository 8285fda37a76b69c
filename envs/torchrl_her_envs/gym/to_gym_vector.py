"""Many environments of a task as a gymnasium vector environment."""

from __future__ import annotations

import operator
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from torchrl_her_envs.gym.to_gym import (
    FPS,
    GoalRules,
    Observation,
    as_seed,
    check_pictures,
    make_core,
    spaces_of,
)
from torchrl_her_envs.throwing.core import Shown
from torchrl_her_envs.throwing.rendering.render import render
from torchrl_her_envs.throwing.rules import reward_of
from torchrl_her_envs.throwing.tasks import WorldConfig

Step = tuple[Observation, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]


class GymVectorTask(GoalRules, VectorEnv[Observation, np.ndarray, np.ndarray]):
    """N environments of a task that share one physics space.

    Environment k does what a single ``GymTask`` (in :mod:`~torchrl_her_envs.gym.to_gym`) with seed
    ``seed + k`` does.

    Args:
        task: one of :data:`~torchrl_her_envs.TASKS`.

    Keyword Args:
        num_envs: N, the number of environments.
        max_episode_steps: steps after which an episode is truncated.
        autoreset_mode: when an environment whose episode is over begins a new one: in place of its next step
            (``NEXT_STEP``), at once (``SAME_STEP``; how the episode ended is in ``info["final_obs"]`` and
            ``info["final_info"]``), or by ``reset(options={"reset_mask": ...})`` (``DISABLED``).
        render_mode: ``"rgb_array"`` or None.
        size: side of a picture in pixels.
        options: ``world``, ``num_links`` and ``threshold``, as for ``GymTask``.

    Raises:
        ValueError: task or mode is unknown, a number is below 1, or the threshold is not positive.

    Example:
        >>> import gymnasium
        >>> env = gymnasium.make_vec("torchrl_her/RobotReach-v0", num_envs=4)
        >>> shown, _ = env.reset(seed=0)
        >>> shown["observation"].shape
        (4, 11)
        >>> env.step(env.action_space.sample())[1].shape
        (4,)
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": FPS}  # noqa: RUF012

    def __init__(
        self,
        task: str,
        *,
        num_envs: int = 1,
        max_episode_steps: int = WorldConfig.max_steps,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        size: int = 300,
        **options: Any,
    ) -> None:
        check_pictures(render_mode, self.metadata["render_modes"], size)
        self._core = make_core(task, num_envs, max_episode_steps, **options)
        self.num_envs = num_envs
        self.single_observation_space, self.single_action_space = spaces_of(self._core)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = self.metadata | {"autoreset_mode": self.autoreset_mode}
        self.render_mode = render_mode
        self._size = size
        self._over = np.zeros(num_envs, np.bool_)  # environments whose episodes are over
        self._seeded = False

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begins episodes.

        Args:
            seed: seed s of the first environment, with s + 1 for the second and so on; or a list of a seed or
                None for each environment, where None draws a seed.
            options: ``{"reset_mask": [N] of bool}`` resets those environments alone.

        Raises:
            ResetNeeded: a mask leaves out environments in the first reset.
            TypeError: a seed is not an integer.
            ValueError: a seed is out of range, only some environments get seeds, or a mask chooses none.
        """
        mask = np.asarray((options or {}).get("reset_mask", np.ones(self.num_envs)), np.bool_)
        if mask.shape != (self.num_envs,) or not mask.any():
            raise ValueError(
                f"reset_mask must choose some of {self.num_envs} environments, got {mask.tolist()}"
            )
        if seed is not None and not mask.all():
            raise ValueError("seed and reset_mask must not be given together")
        if not self._seeded and not mask.all():
            raise ResetNeeded(f"the first reset must be of all environments, got reset_mask {mask.tolist()}")
        if seed is not None or not self._seeded:
            self._set_seeds(seed)
        self._begin(mask)
        return _dict(self._core.show()), {}

    def step(self, actions: np.ndarray) -> Step:
        """Makes one step of 0.04 s in all environments.

        Raises:
            ResetNeeded: an environment must be reset first.
            ValueError: an action is not finite.
        """
        before = self._over
        if not self._seeded or (self.autoreset_mode is AutoresetMode.DISABLED and before.any()):
            raise ResetNeeded("reset must be called before step, for each environment whose episode is over")
        core = self._core
        core.advance(np.asarray(actions, np.float32))
        shown = core.show()
        terminated, truncated = core.achieved(shown.achieved_goal, shown.desired_goal), core.out_of_time()
        reward = reward_of(terminated).astype(np.float32)
        info = {"is_success": terminated.copy(), "_is_success": np.ones_like(terminated)}
        self._over = terminated | truncated
        if self.autoreset_mode is AutoresetMode.NEXT_STEP and before.any():
            self._begin(before)
            shown = core.show()
            for entry in (reward, terminated, truncated, *info.values()):
                entry[before] = 0
        elif self.autoreset_mode is AutoresetMode.SAME_STEP and self._over.any():
            info = _ended(_dict(shown), terminated, self._over)
            self._begin(self._over)
            shown = core.show()
        return _dict(shown), reward, terminated, truncated, info

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Renders a picture [size, size, 3] of uint8 for each environment; None without a render mode."""
        if self.render_mode is None:
            return None
        return tuple(render(self._core, None, size=self._size).numpy())

    def _set_seeds(self, seed: int | Sequence[int | None] | None) -> None:
        if seed is None or isinstance(seed, int | np.integer):
            super().reset(seed=None if seed is None else int(seed))
            first = as_seed(self.np_random_seed)
            seeds: Sequence[int] = [as_seed(first + k) for k in range(self.num_envs)]
        else:
            if len(seed) != self.num_envs:
                raise ValueError(
                    f"{len(seed)} seeds for {self.num_envs} environments: give one, or one for each"
                )
            seeds = [self._drawn_seed() if value is None else operator.index(value) for value in seed]
        self._core.set_seeds(seeds)
        self._seeded = True

    def _drawn_seed(self) -> int:
        return int(self.np_random.integers(1 << 63))

    def _begin(self, mask: np.ndarray) -> None:
        """Begins new episodes in some environments."""
        self._over = self._over & ~mask
        self._core.begin(mask.nonzero()[0])


def _dict(shown: Shown) -> Observation:
    _, observation, achieved_goal, desired_goal = shown
    return {"observation": observation, "achieved_goal": achieved_goal, "desired_goal": desired_goal}


def _ended(observation: Observation, terminated: np.ndarray, over: np.ndarray) -> dict[str, Any]:
    """Returns the info about ended episodes, in the form of gymnasium's own vectors."""
    final = np.full(len(over), None, object)
    for index in over.nonzero()[0]:
        final[index] = {key: values[index] for key, values in observation.items()}
    return {
        "is_success": np.zeros_like(over),
        "_is_success": ~over,
        "final_obs": final,
        "_final_obs": over.copy(),
        "final_info": {"is_success": terminated.copy(), "_is_success": over.copy()},
        "_final_info": over.copy(),
    }
