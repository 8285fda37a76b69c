"""Checks on one gymnasium environment before many are made: does it follow GoalEnv, and what does it lack?"""

from __future__ import annotations

import importlib
import inspect
from typing import Any, cast

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec, load_env_creator

KEYS = ("observation", "achieved_goal", "desired_goal")
METHODS = ("compute_reward", "compute_terminated")
_OUR_OPTIONS = ("max_steps", "parallel")  # of make_gym_env, for every environment
_EPISODES = 8  # whose goals the environment's functions are tried with


def spec_of(env: gymnasium.Env) -> EnvSpec:
    """The spec by which gymnasium made an environment."""
    return cast(EnvSpec, env.spec)


def shown_of(space: spaces.Space) -> spaces.Dict:
    """The space of observations of an environment that was checked."""
    return cast(spaces.Dict, space)


def make_one(id: str, options: dict[str, Any]) -> gymnasium.Env:
    """Makes one environment; where that fails, the message has one line and names what is wrong.

    Raises:
        ValueError: there is no such environment, or it does not take an option.
        ImportError: a package that it needs is not installed.
    """
    hint = _register_robotics(id)
    try:
        return gymnasium.make(id, disable_env_checker=True, **options)
    except (gymnasium.error.DependencyNotInstalled, ImportError) as error:
        raise ImportError(_cannot_make(id, error)) from error
    except TypeError as error:
        raise ValueError(_wrong_options(id, options) or _cannot_make(id, error)) from error
    except gymnasium.error.Error as error:
        raise ValueError(_cannot_make(id, error) + hint) from error


def _wrong_options(id: str, options: dict[str, Any]) -> str:
    """What to say if an environment does not take some of the options; nothing if that cannot be told."""
    known = gymnasium.registry.get(id.partition(":")[2] or id)
    if known is None or known.entry_point is None:
        return ""
    entry = known.entry_point
    taken = inspect.signature(load_env_creator(entry) if isinstance(entry, str) else entry).parameters
    if any(own.kind is inspect.Parameter.VAR_KEYWORD for own in taken.values()):
        return ""
    allowed = [*_OUR_OPTIONS, *(name for name in taken if name not in known.kwargs)]
    wrong = [name for name in options if name not in (*allowed, *known.kwargs, "max_episode_steps")]
    if not wrong:
        return ""
    return f"{id} takes no option {wrong[0]!r}; its options are {', '.join(allowed)}"


def _cannot_make(id: str, error: Exception) -> str:
    return f"cannot make the gymnasium environment {id!r}: {_line(error)}"


def _register_robotics(id: str) -> str:
    """Registers the environments of gymnasium-robotics; returns what to say if they are not installed."""
    if ":" not in id and id not in gymnasium.registry:
        try:
            importlib.import_module("gymnasium_robotics")
        except ModuleNotFoundError:
            return " (gymnasium-robotics is not installed: pip install '.[robotics]')"
    return ""


def _line(error: Exception) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__


def check_goal_env(id: str, env: gymnasium.Env) -> None:
    """Raises a ValueError that names what an environment lacks of GoalEnv or of what training needs."""
    _check_shown(id, env.observation_space)
    for name in METHODS:
        if not env.has_wrapper_attr(name):
            raise ValueError(f"{id} lacks the method {name!r}, which tells what other goals would have given")
    if not isinstance(env.action_space, spaces.Box | spaces.Discrete):
        raise ValueError(f"{id}'s actions must be a Box or Discrete, got {env.action_space}")
    if isinstance(env.action_space, spaces.Box) and not env.action_space.is_bounded():
        raise ValueError(f"{id}'s actions must have bounds, got {env.action_space}")
    if spec_of(env).max_episode_steps is None:
        raise ValueError(f"{id} has no time limit: give max_steps")


def _check_shown(id: str, shown: spaces.Space) -> None:
    if not isinstance(shown, spaces.Dict):
        raise ValueError(f"{id} shows no dict of {', '.join(KEYS)}, but a {type(shown).__name__}")
    for key in KEYS:
        if key not in shown.spaces:
            raise ValueError(f"{id} lacks {key!r} in what it shows: {', '.join(shown.spaces)}")
        if len(shown[key].shape or ()) != 1:
            raise ValueError(f"{id} must show {key!r} as a row of numbers, got {shown[key]}")
    achieved, desired = (shown[key].shape for key in KEYS[1:])
    if achieved != desired:
        raise ValueError(
            f"{id}'s achieved and desired goals must have one shape, got {achieved} and {desired}"
        )


def goals_to_try(env: gymnasium.Env) -> tuple[np.ndarray, np.ndarray]:
    """Achieved and desired goals [M, g] of real episodes: first a pair far apart, then some equal pairs."""
    shown = [env.reset(seed=seed)[0] for seed in range(_EPISODES)]
    achieved, desired = (np.stack([own[key] for own in shown]) for key in KEYS[1:])
    gap = np.abs(achieved[:, None].astype(np.float64) - desired).sum(-1)
    here, there = np.unravel_index(gap.argmax(), gap.shape)
    met = 3 if achieved.shape[1] == 3 else 2  # M must not be g, see GoalFunction
    return (
        np.concatenate([achieved[here, None], desired[:met]]),
        np.concatenate([desired[there, None], desired[:met]]),
    )
