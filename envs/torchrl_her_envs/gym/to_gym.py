"""The throwing and reaching tasks as gymnasium environments."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from torchrl_her_envs.throwing.core import ThrowingCore
from torchrl_her_envs.throwing.rendering.canvas import check_size
from torchrl_her_envs.throwing.rendering.render import render
from torchrl_her_envs.throwing.rules import reward_of
from torchrl_her_envs.throwing.tasks import WorldConfig, get_task

Observation = dict[str, Any]  # arrays by name

KEYS = ("observation", "achieved_goal", "desired_goal")
FPS = 25
_FIRST = np.zeros(1, np.int64)  # the index of the only environment
_NO_LIMIT = 1 << 60  # number of steps that no episode reaches: gymnasium's TimeLimit truncates episodes


class GoalRules:
    """Functions of goals that gymnasium's GoalEnv requires, for one pair of goals or many."""

    _core: ThrowingCore

    def compute_reward(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any) -> Any:
        """Computes the reward of having achieved one goal when another was desired.

        Args:
            achieved_goal: [..., 2], the achieved goals.
            desired_goal: [..., 2], broadcast against ``achieved_goal``.
            info: not used.

        Returns:
            Rewards [...]: 0 where the goals' distance is below the task's threshold, -1 elsewhere.
        """
        achieved_goal = np.asarray(achieved_goal)
        rewards = reward_of(self._achieved(achieved_goal, desired_goal))
        return rewards.astype(np.result_type(achieved_goal, np.float16))[()]

    def compute_terminated(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any) -> Any:
        """Returns whether goals are achieved, which ends an episode, as bool [...]."""
        return self._achieved(achieved_goal, desired_goal)[()]

    def compute_truncated(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any) -> Any:
        """Returns False [...] for all pairs of goals: only the time limit truncates episodes."""
        shape = np.broadcast_shapes(np.shape(achieved_goal), np.shape(desired_goal))
        return np.zeros(shape[:-1], np.bool_)[()]

    def _achieved(self, achieved_goal: Any, desired_goal: Any) -> np.ndarray:
        return self._core.achieved(np.asarray(achieved_goal), np.asarray(desired_goal))


class GymTask(GoalRules, gymnasium.Env[Observation, np.ndarray]):
    """A throwing or reaching task as a gymnasium environment.

    Observations are a dict of ``observation``, ``achieved_goal`` and ``desired_goal`` (float32), actions
    are in [-1, 1], the reward is 0 where the goal is achieved and -1 elsewhere: see
    :class:`~torchrl_her_envs.ThrowingEnv`. ``info["is_success"]`` is whether the goal is achieved,
    which also ends the episode. The time limit is the one that ``gymnasium.make`` adds.

    Args:
        task: one of :data:`~torchrl_her_envs.TASKS`.

    Keyword Args:
        render_mode: ``"rgb_array"``, ``"human"`` (a window of matplotlib) or None.
        size: side of a picture in pixels.
        world: the constants of the physics; ``max_steps`` among them has no effect.
        num_links: number of links of the arm, for the robot's tasks.
        threshold: distance below which a goal is achieved, in observed coordinates; the task's own if None.

    Raises:
        ValueError: task or mode is unknown, a number is below 1, or the threshold is not positive.

    Example:
        >>> env = gymnasium.make("torchrl_her/HandThrow-v2")
        >>> shown, _ = env.reset(seed=0)
        >>> {key: value.shape for key, value in shown.items()}
        {'observation': (9,), 'achieved_goal': (2,), 'desired_goal': (2,)}
    """

    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array"], "render_fps": FPS}  # noqa: RUF012

    def __init__(
        self,
        task: str,
        *,
        render_mode: str | None = None,
        size: int = 300,
        world: WorldConfig | None = None,
        num_links: int = 2,
        threshold: float | None = None,
    ) -> None:
        check_pictures(render_mode, self.metadata["render_modes"], size)
        self._core = make_core(task, 1, _NO_LIMIT, world=world, num_links=num_links, threshold=threshold)
        self.observation_space, self.action_space = spaces_of(self._core)
        self.render_mode = render_mode
        self._size = size
        self._window: Any = None
        self._seeded = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begins an episode.

        Args:
            seed: seed of this episode and the following ones; None continues the random numbers of the last
                seed.
            options: not used.
        """
        super().reset(seed=seed, options=options)
        if seed is not None or not self._seeded:
            self._core.set_seeds([as_seed(self.np_random_seed)])
            self._seeded = True
        self._core.begin(_FIRST)
        self._show()
        return self._observation(), {}

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Makes one step of 0.04 s.

        Raises:
            ValueError: an action is not finite.
        """
        core = self._core
        core.advance(np.asarray(action, np.float32)[None])
        observation = self._observation()
        achieved = core.achieved(observation["achieved_goal"], observation["desired_goal"])
        terminated = bool(achieved)
        if self.render_mode == "human":
            self._show()
        return observation, reward_of(terminated), terminated, False, {"is_success": terminated}

    def render(self) -> np.ndarray | None:
        """Renders a picture [size, size, 3] of uint8; None if a window shows it, or without a render mode."""
        return self._picture() if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Closes the window if there is one."""
        if self._window is not None:
            self._window.close()
            self._window = None

    def _observation(self) -> Observation:
        (state,) = self._core.show_state()  # a new array, which no other object shares
        return {
            "observation": state[:-2],
            "achieved_goal": state[self._core.achieved_index].copy(),  # the observation shares this memory
            "desired_goal": state[-2:],
        }

    def _picture(self) -> np.ndarray:
        return render(self._core, 0, size=self._size).numpy()

    def _show(self) -> None:
        """Shows the present picture in the window if the render mode is ``human``."""
        if self.render_mode != "human":
            return
        if self._window is None:
            from torchrl_her_envs.common.rendering.window import (  # noqa: PLC0415  (matplotlib's windows load slowly)
                Window,
            )

            self._window = Window(self._core.task.summary, fps=1 / self._core.world.time_step)
        self._window.show(self._picture())


def make_core(
    task: str, num_envs: int, max_steps: int, *, world: WorldConfig | None = None, **options: Any
) -> ThrowingCore:
    """Makes a batch of worlds whose episodes have a given length."""
    return ThrowingCore(
        get_task(task),
        num_envs,
        world=replace(world or WorldConfig(), max_steps=max_steps),
        **options,
    )


def check_pictures(mode: str | None, modes: list[str], size: int) -> None:
    """Raises a ValueError for an unknown render mode, or a size that is too small."""
    check_size(size)
    if mode is not None and mode not in modes:
        raise ValueError(f"render_mode must be one of {', '.join(modes)}, or None, got {mode!r}")


def as_seed(seed: int | None) -> int:
    """Converts a seed of gymnasium's, which may be any number, to one below 2**64.

    Example:
        >>> as_seed(7), as_seed((1 << 64) + 7)
        (7, 7)
    """
    return (seed or 0) % (1 << 64)


def spaces_of(core: ThrowingCore) -> tuple[spaces.Dict, spaces.Box]:
    """Returns the spaces of observations and actions of a single environment."""
    limit = _largest(core)
    widths = dict(zip(KEYS, (core.observation_size, 2, 2), strict=True))
    entries: dict[str, spaces.Space] = {
        key: spaces.Box(-limit, limit, (width,), np.float32) for key, width in widths.items()
    }
    return spaces.Dict(entries), spaces.Box(-1.0, 1.0, (core.effector.num_joints + 1,), np.float32)


def _largest(core: ThrowingCore) -> float:
    """Returns a bound on all observed numbers: positions are about [-1, 1], but falling balls are fast."""
    places = max(abs(2 * side - 1) for side in (0.0, 1.0, *core.effector.reach))
    return 1.01 * max(places, core.fastest_ball / core.world.hand_speed)
