"""All tasks by name. Importing this module does not import torch; :func:`make_env` does."""

from __future__ import annotations

import importlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from difflib import SequenceMatcher
from typing import TYPE_CHECKING, Any, Literal

from torchrl_her_envs.throwing.tasks import TASKS

if TYPE_CHECKING:  # this import would load torch
    from torchrl.envs import EnvBase

GYM = "gym:"  # prefix of the id of a gymnasium environment
_OWN = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z_]\w*")  # module:function
_OTHERS = f"or {GYM}ID for one of gymnasium's, or my_module:make_env for a TorchRL environment of your own"
_ALIKE = 0.6  # the least similarity, from 0 to 1, at which another name is suggested


@dataclass(frozen=True, kw_only=True)
class TaskSpec:
    """Facts about a task that are known before its environment is made.

    Args:
        name: name for :func:`make_env`, without a colon.
        summary: one-line description for users.
        family: group of tasks that it belongs to, such as ``"throwing"`` or ``"toy"``.
        make: the function or class that makes the environment, as ``"module:name"``; it is imported when
            it is first used. It takes ``num_envs``, ``seed``, the arguments and the options.
        arguments: arguments that ``make`` always gets, besides the options.
        options: all options that the task takes, with their defaults.
        actions: kind of its actions; None if this is unknown before its environment is made.
        takes_others: whether it may take further options, which are only known when it is made.
        for_pictures: options that its environments need in order to be rendered.

    Example:
        >>> get_task_spec("bit_flip").options
        {'bits': 15, 'useless_action': False, 'max_steps': None}
    """

    name: str
    summary: str
    family: str
    make: str
    arguments: Mapping[str, Any] = field(default_factory=dict)
    options: Mapping[str, Any] = field(default_factory=dict)
    actions: Literal["continuous", "discrete"] | None = None
    takes_others: bool = False
    for_pictures: Mapping[str, Any] = field(default_factory=dict)


_SPECS: dict[str, TaskSpec] = {}
_BUILT_IN: tuple[str, ...] = ()  # names of this package's tasks


def register_task(spec: TaskSpec) -> None:
    """Registers a task for :func:`make_env`.

    Args:
        spec: description of the task.

    Raises:
        ValueError: the name has a colon, or is that of a task of this package or of one with another
            ``make``, or ``make`` is not of the form ``"module:name"``.

    Example:
        >>> register_task(get_task_spec("chain"))
        Traceback (most recent call last):
        ValueError: the task 'chain' is registered already
    """
    if spec.name in _BUILT_IN or _SPECS.get(spec.name, spec).make != spec.make:
        raise ValueError(f"the task {spec.name!r} is registered already")
    if not spec.name or ":" in spec.name:
        raise ValueError(f"a task's name must be some text without a colon, got {spec.name!r}")
    module, _, function = spec.make.partition(":")
    if not module or not function:
        raise ValueError(f"make must be 'module:name', got {spec.make!r}")
    _SPECS[spec.name] = spec


def task_names() -> list[str]:
    """Returns the names of all tasks, in the order in which they were registered.

    Example:
        >>> task_names()[:2], task_names()[-1]
        (['hand_reach', 'hand_v0'], 'chain')
    """
    return list(_SPECS)


def get_task_spec(name: str) -> TaskSpec:
    """Returns the facts about a task.

    Args:
        name: one of :func:`task_names`, ``gym:ID`` for an environment of gymnasium's, or
            ``module:function`` for a TorchRL environment of one's own.

    Raises:
        ValueError: there is no such task.

    Example:
        >>> get_task_spec("hand_v0").family, get_task_spec("gym:FetchReach-v4").family
        ('throwing', 'gym')
    """
    check_task(name)
    if name in _SPECS:
        return _SPECS[name]
    return _gym_spec(name.removeprefix(GYM)) if name.startswith(GYM) else _own_spec(name)


def module_of(name: str) -> str:
    """Returns the name of the user's module that :func:`make_env` imports for a task.

    Returns:
        The module's name; empty for tasks of this package and for those that gymnasium has registered.

    Example:
        >>> module_of("my_module:make_env"), module_of("gym:my_module:MyEnv-v0"), module_of("hand_v0")
        ('my_module', 'my_module', '')
    """
    module, colon, _ = name.removeprefix(GYM).partition(":")
    return module if colon else ""


def check_task(name: str) -> None:
    """Raises a ValueError for an unknown task; the message lists all tasks and suggests the nearest name.

    An unknown ID in ``gym:ID``, or a function that its module lacks, raises an error only when the
    environment is made.

    Example:
        >>> check_task("gym:FetchReach-v4")
        >>> check_task("hand_v9")
        Traceback (most recent call last):
        ValueError: unknown task 'hand_v9'; did you mean hand_v0? The tasks are ..., or gym:ID for one of
        gymnasium's, or my_module:make_env for a TorchRL environment of your own
    """
    if name in _SPECS or (name.startswith(GYM) and name != GYM) or _OWN.fullmatch(name):
        return
    likeness = {known: SequenceMatcher(None, name, known).ratio() for known in _SPECS}
    nearest = max(_SPECS, key=likeness.__getitem__)
    hint = f"did you mean {nearest}? The" if likeness[nearest] >= _ALIKE else "the"
    raise ValueError(f"unknown task {name!r}; {hint} tasks are {', '.join(_SPECS)}, {_OTHERS}")


def make_env(name: str, *, num_envs: int = 1, seed: int | Sequence[int] = 0, **options: Any) -> EnvBase:
    """Makes a batch of environments of a task.

    Args:
        name: one of :func:`task_names`, ``gym:ID`` for an environment of gymnasium's, or
            ``module:function`` for a TorchRL environment of one's own; the module is imported.
        num_envs: number of environments.
        seed: seed of all that is random; R seeds for R equal blocks of environments, each as if alone.
        options: options of the task (see :class:`TaskSpec`), for ``gym:ID`` those of
            :func:`~torchrl_her_envs.make_gym_env`, for ``module:function`` those of
            :func:`~torchrl_her_envs.make_own_env`.

    Raises:
        ValueError: the task is unknown or does not take an option, or a value is out of its range.
        ImportError: a package that the task needs is not installed.

    Example:
        >>> make_env("hand_v0", num_envs=2, seed=0).reset()["observation"].shape
        torch.Size([2, 9])
        >>> make_env("bit_flip", bits=4).reset()["observation"].shape
        torch.Size([1, 4])
    """
    spec = get_task_spec(name)
    check_options(spec, options)
    module, _, function = spec.make.partition(":")
    maker = getattr(importlib.import_module(module), function)
    return maker(num_envs=num_envs, seed=seed, **{**spec.options, **options, **spec.arguments})


def check_options(spec: TaskSpec, options: Mapping[str, Any]) -> None:
    """Raises a ValueError for an option that a task does not take, and lists its options.

    Example:
        >>> check_options(get_task_spec("treasure_hunt"), {"bits": 4})
        Traceback (most recent call last):
        ValueError: treasure_hunt takes no option 'bits'; its options are step, max_steps
    """
    for option in options:
        if option not in spec.options and not spec.takes_others:
            allowed = f"its options are {', '.join(spec.options)}" if spec.options else "it has none"
            raise ValueError(f"{spec.name} takes no option {option!r}; {allowed}")


def _gym_spec(id: str) -> TaskSpec:
    return TaskSpec(
        name=GYM + id,
        summary=f"gymnasium's {id}",
        family="gym",
        make="torchrl_her_envs.gym.from_gym:make_gym_env",
        arguments={"id": id},
        options={
            "max_steps": None,
            "parallel": False,
            "termination": "auto",
            "achieved_reward": None,
            "info_keys": (),
            "shaping": None,
        },
        takes_others=True,
        for_pictures={"pictures": True},
    )


def _own_spec(path: str) -> TaskSpec:
    return TaskSpec(
        name=path,
        summary=f"{path}, of one's own",
        family="own",
        make="torchrl_her_envs.common.own_env:make_own_env",
        arguments={"path": path},
        options={"max_steps": None, "termination": "auto", "achieved_reward": None, "info_keys": ()},
        takes_others=True,
    )


# The tasks of this package.

for _task in TASKS.values():
    register_task(
        TaskSpec(
            name=_task.name,
            summary=_task.summary,
            family="throwing",
            make="torchrl_her_envs.throwing.env:ThrowingEnv",
            arguments={"task": _task},
            options={"world": None, "num_links": 2, "threshold": None, "dtype": "float32"},
            actions="continuous",
        )
    )

for _spec in (
    TaskSpec(
        name="bit_flip",
        summary="flip bits until they are the ones that are wanted",
        family="toy",
        make="torchrl_her_envs.toy.bit_flip:BitFlip",
        options={"bits": 15, "useless_action": False, "max_steps": None},
        actions="discrete",
    ),
    TaskSpec(
        name="treasure_hunt",
        summary="walk on a line from 0 to 100 to a treasure",
        family="toy",
        make="torchrl_her_envs.toy.treasure_hunt:TreasureHunt",
        options={"step": 1, "max_steps": None},
        actions="discrete",
    ),
    TaskSpec(
        name="chain",
        summary="walk a chain from its first place to its last",
        family="toy",
        make="torchrl_her_envs.toy.chain:Chain",
        options={
            "length": 10,
            "forward_probability": 1.0,
            "stages": 1,
            "alternating": False,
            "reset_state": False,
            "max_steps": None,
        },
        actions="discrete",
    ),
):
    register_task(_spec)
_BUILT_IN = tuple(_SPECS)
