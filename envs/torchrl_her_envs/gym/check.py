"""Checks that a gymnasium environment follows GoalEnv, before many of its kind are made."""

from __future__ import annotations

import importlib
import inspect
import io
from collections.abc import Mapping
from contextlib import redirect_stderr
from dataclasses import dataclass
from typing import Any, cast

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec, load_env_creator

from torchrl_her_envs.common.goal_env import Names
from torchrl_her_envs.gym.goal_functions import GoalFunction
from torchrl_her_envs.gym.layout import Layout
from torchrl_her_envs.gym.quiet import make_quietly

KEYS = ("observation", "achieved_goal", "desired_goal")
REWARD, TERMINATED = "compute_reward", "compute_terminated"
SUCCESS = "is_success"
# Options of make_gym_env that every environment takes.
_OUR_OPTIONS = (
    *("max_steps", "parallel", "termination", "achieved_reward", "info_keys", "shaping"),
    *(f"{key}_key" for key in KEYS),
    "pictures",
)
EPISODES = 8  # number of first states whose goals serve to try the environment's functions
_TRIED_STEPS = 100
_LIMIT_STEPS = 1_000  # random steps in which an environment may show its own time limit
_LIMIT = 100  # number of steps of an episode, if no time limit is found
_HALVINGS = 30
_COARSE = 0.05  # rounding step of float32 that is too large, relative to a goal's standard deviation
_NOISE = 1e-5  # standard deviation of an entry of goals, relative to the largest, below which it is noise


def spec_of(env: gymnasium.Env) -> EnvSpec:
    """Returns the spec by which gymnasium made an environment."""
    return cast(EnvSpec, env.spec)


def shown_of(space: spaces.Space) -> spaces.Dict:
    """Returns the space of observations of a checked environment."""
    return cast(spaces.Dict, space)


def make_one(id: str, names: Mapping[str, Names] | None, options: dict[str, Any]) -> gymnasium.Env:
    """Makes one environment; if that fails, a message of one line names the reason.

    Args:
        id: id of the environment.
        names: names of its entries, see :func:`~torchrl_her_envs.gym.quiet.make_quietly`.
        options: options of the environment.

    Raises:
        ValueError: there is no such environment, or it does not take an option.
        ImportError: a package that it needs is not installed.
    """
    hint = _register_robotics(id)
    try:
        return make_quietly(id, names, **options)
    except ModuleNotFoundError as error:
        module, cause = id.partition(":")[0], error.__cause__
        if ":" in id and isinstance(cause, ModuleNotFoundError) and cause.name == module:
            where = "neither in this folder nor among the installed packages"
            error = ModuleNotFoundError(f"there is no module {module!r}, {where}")
        raise ImportError(_cannot_make(id, error)) from error
    except (gymnasium.error.DependencyNotInstalled, ImportError) as error:
        raise ImportError(_cannot_make(id, error)) from error
    except TypeError as error:
        raise ValueError(_wrong_options(id, options) or _cannot_make(id, error)) from error
    except gymnasium.error.UnregisteredEnv as error:
        raise ValueError(f"{_cannot_make(id, error)}{hint}; {_OWN_ID}") from error
    except gymnasium.error.Error as error:
        raise ValueError(_cannot_make(id, error) + hint) from error


_OWN_ID = (
    "an environment of your own is named module:ID, as in task=gym:my_module:MyEnv-v0, "
    "where importing my_module registers MyEnv-v0"
)


def _wrong_options(id: str, options: dict[str, Any]) -> str:
    """Returns the message about options that an environment does not take; empty if this is unknown."""
    known = gymnasium.registry.get(id.partition(":")[2] or id)
    if known is None or known.entry_point is None:
        return ""
    entry = known.entry_point
    parameters = inspect.signature(load_env_creator(entry) if isinstance(entry, str) else entry).parameters
    if any(param.kind is inspect.Parameter.VAR_KEYWORD for param in parameters.values()):
        return ""
    allowed = [*_OUR_OPTIONS, *(name for name in parameters if name not in known.kwargs)]
    wrong = [name for name in options if name not in (*allowed, *known.kwargs, "max_episode_steps")]
    if not wrong:
        return ""
    if wrong == ["render_mode"]:
        return f"{id} gives no pictures: it has render modes in its metadata, but takes no render_mode"
    return f"{id} takes no option {wrong[0]!r}; its options are {', '.join(allowed)}"


def _cannot_make(id: str, error: Exception) -> str:
    return f"cannot make the gymnasium environment {id!r}: {_line(error)}"


def _register_robotics(id: str) -> str:
    """Registers the environments of gymnasium-robotics; returns a hint if they cannot be imported."""
    if ":" not in id and id not in gymnasium.registry:
        try:
            with redirect_stderr(io.StringIO()):  # hides a notice about Adroit tasks, which have no goals
                importlib.import_module("gymnasium_robotics")
        except ModuleNotFoundError as error:
            found = "is not installed" if error.name == "gymnasium_robotics" else f"fails: {_line(error)}"
            return f" (gymnasium-robotics {found}: pip install '.[robotics]')"
    return ""


def _line(error: Exception) -> str:
    return str(error).splitlines()[0].rstrip(".") if str(error) else type(error).__name__


def check_goal_env(id: str, env: gymnasium.Env) -> None:
    """Raises a ValueError that names what an environment lacks of GoalEnv or of what training needs."""
    _check_shown(id, env.observation_space)
    if not env.has_wrapper_attr(REWARD):
        raise ValueError(f"{id} lacks the method {REWARD!r}, which computes the rewards of other goals")
    if not isinstance(env.action_space, spaces.Box | spaces.Discrete):
        raise ValueError(f"{id}'s actions must be a Box or Discrete, got {env.action_space}")
    if isinstance(env.action_space, spaces.Box) and not env.action_space.is_bounded():
        raise ValueError(f"{id}'s actions must have bounds, got {env.action_space}")


def _check_shown(id: str, space: spaces.Space) -> None:
    if not isinstance(space, spaces.Dict):
        got = type(space).__name__
        raise ValueError(f"{id}'s observations must be a dict of {', '.join(KEYS)}, got a {got}")
    for key in KEYS:
        if key not in space.spaces:
            raise ValueError(f"{id}'s observations must have {key!r}, got {', '.join(space.spaces)}")
    achieved, desired = (Layout(space[key], f"{id}'s {key!r}").shapes for key in KEYS[1:])
    Layout(space[KEYS[0]], f"{id}'s {KEYS[0]!r}")
    if achieved != desired:
        one, other = (space[key] if achieved[0][0] else space[key].shape for key in KEYS[1:])
        raise ValueError(f"{id}'s achieved and desired goals must have one shape, got {one} and {other}")


def check_methods(id: str, env: gymnasium.Env) -> None:
    """Raises a ValueError if ``reset`` or ``step`` of an environment or a wrapper has old gym's form."""
    wrappers = [env]
    while isinstance(wrappers[-1], gymnasium.Wrapper):
        wrappers.append(wrappers[-1].env)
    for wrapper in reversed(wrappers):  # the innermost first, since all wrappers around it fail, too
        name = type(wrapper).__name__
        reset, step = f"{id}: reset of {name} must", f"{id}: step of {name} must"
        parameters = inspect.signature(wrapper.reset).parameters
        missing = [key for key in ("seed", "options") if key not in parameters]
        if missing and not any(param.kind is inspect.Parameter.VAR_KEYWORD for param in parameters.values()):
            raise ValueError(f"{reset} take seed and options, as in gymnasium; it lacks {missing[0]!r}")
        wrapper.action_space.seed(0)
        answer = wrapper.reset(seed=0)
        if not isinstance(answer, tuple) or len(answer) != 2:
            raise ValueError(f"{reset} give (observation, info), as in gymnasium, got {_form(answer)}")
        answer = wrapper.step(wrapper.action_space.sample())
        if not isinstance(answer, tuple) or len(answer) != 5:
            raise ValueError(
                f"{step} give (observation, reward, terminated, truncated, info), as in gymnasium, got "
                f"{_form(answer)}"
            )


def _form(answer: object) -> str:
    return f"{len(answer)} values" if isinstance(answer, tuple) else f"a {type(answer).__name__}"


def has_compute_terminated(env: gymnasium.Env, achieved: Any, desired: Any) -> bool:
    """Returns whether an environment implements ``compute_terminated``, and not just a base class's stub."""
    if not env.has_wrapper_attr(TERMINATED):
        return False
    try:
        env.get_wrapper_attr(TERMINATED)(achieved, desired, {})
    except NotImplementedError:
        return False
    except Exception:  # the function exists; GoalFunction reports its errors
        return True
    return True


def goals_to_try(env: gymnasium.Env, layout: Layout) -> tuple[np.ndarray, np.ndarray]:
    """Collects pairs of goals [M, g] of first states: first equal pairs, then achieved with desired goals."""
    observations = [env.reset(seed=seed)[0] for seed in range(EPISODES)]
    achieved, desired = (np.stack([layout.flatten(obs[key]) for obs in observations]) for key in KEYS[1:])
    pairs = np.repeat(achieved, EPISODES, 0), np.tile(desired, (EPISODES, 1))
    # The number M of pairs must differ from all dimensions of a goal, see GoalFunction.
    last = max(m for m in range(EPISODES * (EPISODES + 1) + 1) if m not in layout.sizes)
    achieved, desired = (np.concatenate([desired, goals])[:last] for goals in pairs)
    return achieved, desired


@dataclass(frozen=True)
class Trial:
    """Outcomes of some steps of random actions.

    Attributes:
        achieved, desired: [n, g] goals after each step.
        reward: [n], reward of each step.
        terminated, truncated: [n] of bool, whether the environment ended the episode there.
        success: [n] of bool, the value of ``info["is_success"]``; None if it was missing in all steps.
        infos: n infos, as the environment gave them.
    """

    achieved: np.ndarray
    desired: np.ndarray
    reward: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    success: np.ndarray | None
    infos: list[dict[str, Any]]

    def pairs(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns the steps [m] of up to 8 achieved goals, each paired with each of up to 8 desired ones."""
        chosen = np.unique(np.linspace(0, len(self.reward) - 1, EPISODES).astype(int))
        return np.repeat(chosen, len(chosen)), np.tile(chosen, len(chosen))


def coarse_goals(id: str, achieved: np.ndarray) -> str:
    """Returns a warning if achieved goals [n, g] are so far from 0 that float32 rounds their changes."""
    size, spread = np.abs(achieved).max(0), achieved.std(0, dtype=np.float64)
    steps = np.spacing(size.astype(np.float32))
    coarse = (spread > _NOISE * spread.max()) & (steps > _COARSE * spread)
    if not coarse.any():
        return ""
    at = int(coarse.argmax())
    return (
        f"{id}: achieved_goal {at} is about {size[at]:,.0f}, where float32 has steps of {steps[at]:g}, and "
        f"changes by {spread[at]:.2g}: subtract a constant from it in the environment"
    )


def find_limit(env: gymnasium.Env) -> int:
    """Returns the length of the longest random episode that is truncated; 100 if no episode is truncated."""
    env.action_space.seed(0)
    longest = length = 0
    env.reset(seed=0)
    for _ in range(_LIMIT_STEPS):
        *_, terminated, truncated, _ = env.step(env.action_space.sample())
        length += 1
        if truncated:
            longest = max(longest, length)
        if terminated or truncated:
            env.reset()
            length = 0
    return longest or _LIMIT


def find_achieved_reward(
    env: gymnasium.Env, layout: Layout, reward: GoalFunction, achieved: np.ndarray, desired: np.ndarray
) -> float | None:
    """Finds the least reward at which an environment's own ``_is_success`` counts a goal as achieved.

    Fetch and highway-env have this method. It is called with goals on the way from each desired goal to the
    achieved one.

    Args:
        env: environment with a dense reward.
        layout: layout of its goals.
        reward: the environment's reward function.
        achieved, desired: [m, g] goals, most of which are not achieved.

    Returns:
        The reward; None if there is no such method, or if its results do not follow from the reward.
    """
    if not env.has_wrapper_attr("_is_success"):
        return None
    is_success = env.get_wrapper_attr("_is_success")

    def goals(share: np.ndarray) -> np.ndarray:
        return (desired + share[:, None] * (achieved - desired)).astype(desired.dtype)

    def met(share: np.ndarray) -> np.ndarray:
        pairs = zip(goals(share), desired, strict=True)
        return np.array([bool(is_success(*map(layout.unflatten, pair))) for pair in pairs])

    missed = ~met(np.ones(len(desired)))
    achieved, desired = achieved[missed], desired[missed]
    near, far = np.zeros(len(desired)), np.ones(len(desired))
    if not len(desired) or not met(near).all():
        return None
    for _ in range(_HALVINGS):
        middle = (near + far) / 2
        inside = met(middle)
        near, far = np.where(inside, middle, near), np.where(inside, far, middle)
    least = reward(goals(near), desired)
    return float(least.min()) if np.allclose(least, least.min(), rtol=1e-3) else None


def try_steps(env: gymnasium.Env, layout: Layout, *, at_goals: bool = False) -> Trial:
    """Plays episodes of random actions, the same ones in each call.

    Args:
        env: environment to be played.
        layout: layout of its goals.

    Keyword Args:
        at_goals: whether each step begins at its goal: the desired goal is set to the achieved one, if the
            environment or its ``task`` has an array ``goal`` (gymnasium-robotics and panda-gym do).
    """
    env.action_space.seed(0)
    owners: list[Any] = [env.unwrapped, getattr(env.unwrapped, "task", None)] if at_goals else []
    rows: list[tuple[Any, ...]] = []
    done = True
    for step in range(_TRIED_STEPS):
        if done:
            observation, _ = env.reset(seed=step)
        for owner in owners:
            if isinstance(getattr(owner, "goal", None), np.ndarray):
                owner.goal = np.array(observation["achieved_goal"])
        observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        done = terminated or truncated
        goals = (layout.flatten(observation[key]) for key in KEYS[1:])
        rows.append((*goals, float(reward), bool(terminated), bool(truncated), info.get(SUCCESS), info))
    achieved, desired, rewards, terminations, truncations, success, infos = zip(*rows, strict=True)
    known = any(flag is not None for flag in success)
    return Trial(
        achieved=np.stack(achieved),
        desired=np.stack(desired),
        reward=np.array(rewards),
        terminated=np.array(terminations),
        truncated=np.array(truncations),
        success=np.array([bool(flag) for flag in success]) if known else None,
        infos=list(infos),
    )
