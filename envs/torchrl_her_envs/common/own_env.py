"""Makes a user's TorchRL environment, given as ``module:function``, as an environment with goals."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable, Sequence
from typing import Any

from torchrl.envs import EnvBase

from torchrl_her_envs.common.goal_env import GoalEnv, Names
from torchrl_her_envs.common.own_goal_env import KEYS, OwnGoalEnv
from torchrl_her_envs.common.seeding import block_keys

# Options of make_own_env that apply to every environment, besides the options of the user's function.
_OURS = ("max_steps", "termination", "achieved_reward", "info_keys", *(f"{key}_key" for key in KEYS))


def make_own_env(
    path: str,
    *,
    num_envs: int = 1,
    seed: int | Sequence[int] = 0,
    max_steps: int | None = None,
    termination: str = "auto",
    achieved_reward: float | None = None,
    info_keys: Sequence[str] = (),
    observation_key: Names = "observation",
    achieved_goal_key: Names = "achieved_goal",
    desired_goal_key: Names = "desired_goal",
    **options: Any,
) -> EnvBase:
    """Makes a batch of a user's own environment.

    Args:
        path: ``"module:name"`` of a function or class that makes a TorchRL ``EnvBase``; the module is
            imported. ``seed`` and ``max_steps`` are passed if the function takes them. A function that takes
            ``num_envs`` must make a batch [num_envs] of environments; it is called once for R seeds if the
            batch has ``set_seeds``, and otherwise R times. A function without ``num_envs`` is called
            ``num_envs`` times, and makes single environments, which are stepped one after the other.
        num_envs: number of environments.
        seed: seed of all environments; R seeds for R equal blocks of them.
        max_steps: length of an episode; the environment's attribute ``max_steps`` if None.
        termination: rule that ends an episode at its goal, see :class:`OwnGoalEnv`.
        achieved_reward: the least reward at which a goal counts as achieved, for dense rewards.
        info_keys: entries of a step that rewards read besides goals, see :class:`OwnGoalEnv`.
        observation_key, achieved_goal_key, desired_goal_key: the environment's names of these entries. The
            entries of a list are joined in order; the environment's functions get them as a dictionary.
        options: options of the function.

    Returns:
        The environments themselves if they are :class:`~torchrl_her_envs.GoalEnv`; otherwise an
        :class:`OwnGoalEnv` around them.

    Raises:
        ValueError: there is no such module or name, the function makes no ``EnvBase``, or the environment
            lacks an entry or a method.

    Example:
        >>> env = make_own_env("torchrl_her_envs:BitFlip", num_envs=2, bits=4)
        >>> env.reset()["observation"].shape
        torch.Size([2, 4])
    """
    if num_envs < 1:
        raise ValueError(f"num_envs must be at least 1, got {num_envs}")
    make = _load(path)
    # Arguments of a class are those of its __init__, as TorchRL's metaclass adds some of its own.
    signed = make.__init__ if isinstance(make, type) else make  # type: ignore[misc]
    taken = inspect.signature(signed).parameters
    _check_options(path, taken, options)
    if not isinstance(seed, int) and len(seed) == 1:
        (seed,) = seed  # a single integer, which users' environments expect

    def make_one(count: int, seed: int | Sequence[int]) -> EnvBase:
        offered = {"num_envs": count, "seed": seed, "max_steps": max_steps}
        given = {name: value for name, value in offered.items() if name in taken and value is not None}
        env = make(**given, **options)
        _check_made(path, env, [count] if "num_envs" in taken else [])
        return env

    def make_many(count: int, seed: int | Sequence[int]) -> list[EnvBase]:
        if "num_envs" not in taken:
            return [make_one(1, seed) for _ in range(count)]
        if isinstance(seed, int):
            return [make_one(count, seed)]
        block_keys(seed, count)  # raises if seeds do not divide the environments evenly
        share = count // len(seed)
        first = make_one(share, seed[0])
        if callable(getattr(first, "set_seeds", None)):  # one object takes the seeds of all runs
            first.close()
            return [make_one(count, seed)]
        return [first, *(make_one(share, run_seed) for run_seed in seed[1:])]

    envs = make_many(num_envs, seed)
    names = dict(zip(KEYS, (observation_key, achieved_goal_key, desired_goal_key), strict=True))
    if isinstance(envs[0], GoalEnv):
        plain = len(info_keys) == 0 and all(key == name for key, name in names.items())
        if termination not in ("auto", "watch") or achieved_reward is not None or not plain:
            raise ValueError(f"{path} has its own rewards and ends; leave out {', '.join(_OURS[1:])}")
        return envs[0]
    # A single environment is tried, so that the rules found do not depend on the number of environments.
    tried = OwnGoalEnv(
        make_many(1, 0),
        name=path,
        max_steps=max_steps,
        termination=termination,
        achieved_reward=achieved_reward,
        info_keys=info_keys,
        names=names,
    )
    tried.close()
    return OwnGoalEnv(
        envs,
        name=path,
        seed=seed,
        max_steps=max_steps,
        rules=tried.rules,
        info_keys=info_keys,
        names=names,
    )


def _check_made(path: str, env: object, batch_size: list[int]) -> None:
    if not isinstance(env, EnvBase):
        raise ValueError(f"{path} must give a TorchRL EnvBase, got {type(env).__name__}")
    if list(env.batch_size) != batch_size:
        hint = "" if batch_size else ", or take num_envs"
        got = list(env.batch_size)
        raise ValueError(f"{path} must give environments of batch size {batch_size}, got {got}{hint}")


def _load(path: str) -> Callable[..., Any]:
    """Imports the module of a path, and returns its function or class."""
    module, _, name = path.partition(":")
    try:
        make = getattr(importlib.import_module(module), name, None)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module}.".startswith(f"{error.name}."):
            raise  # the module exists, but imports one that is missing
        raise ValueError(
            f"there is no module {module!r} for task={path}, neither in this folder nor among the installed "
            "packages"
        ) from error
    if not callable(make):
        raise ValueError(f"task={path} needs a function or class {name!r} in the module {module!r}")
    return make


def _check_options(path: str, taken: Any, options: dict[str, Any]) -> None:
    kinds = inspect.Parameter
    for name, param in taken.items():
        needed = param.default is kinds.empty and param.kind not in (kinds.VAR_POSITIONAL, kinds.VAR_KEYWORD)
        if needed and name not in ("self", "num_envs", "seed", *options):
            raise ValueError(f"{path} needs the option {name!r}, as in task.options.{name}=...")
    if any(param.kind is kinds.VAR_KEYWORD for param in taken.values()):
        return
    declared = [name for name in taken if name not in ("self", "num_envs", "seed")]
    allowed = list(dict.fromkeys([*_OURS, *declared]))
    for option in options:
        if option not in allowed:
            raise ValueError(f"{path} takes no option {option!r}; its options are {', '.join(allowed)}")
