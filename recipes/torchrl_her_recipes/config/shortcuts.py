"""Finds options by their names, which are short (``seed``) or begin with the group (``run.seed``)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from functools import cache, reduce
from typing import Any

from torchrl_her_recipes.config.algorithms import get_algorithm
from torchrl_her_recipes.config.choices.kind import Kind
from torchrl_her_recipes.config.groups import Groups
from torchrl_her_recipes.config.options import Group, nearest, what_there_is

Nested = dict[str, dict[str, Any]]

GROUPS: dict[str, type[Group] | Kind[Any]] = {
    group.name: group.default_factory  # type: ignore[misc]
    for group in fields(Groups)
}
KINDS = {group: kind for group, kind in GROUPS.items() if isinstance(kind, Kind)}
# former names of options, and their present names, for messages about old recipes
FORMER_NAMES = {
    "products": "matmul_dtype",
    "average_decay": "ema_decay",
    "layers": "stages",
    "layer_epochs": "stage_epochs",
    "layer_epsilon": "stage_epsilon",
    "every_layer": "every_stage",
}
# groups that had options before, and the groups that have them now
FORMER = {"ibs": ("weights", "behavior"), "novelty": ("weights",), "curriculum": ("order",)}
# groups whose options need the group's name: ``file`` alone would be unclear
LONG_ONLY = ("demonstrations",)


# options that every task of gymnasium and every user's task takes
TASK_OPTIONS = ("max_steps", "termination", "achieved_reward", "parallel", "info_keys")


class Entries(dict[str, Any]):
    """Entries to set in an option that is a mapping (``task.options.bits=8``), leaving its other entries."""


def choices_of(group: str) -> dict[str, type[Group]]:
    """Returns the classes of a group's choices by name, the default first; {"": class} without choices."""
    kind = GROUPS[group]
    return {kind.default: kind[kind.default], **kind} if isinstance(kind, Kind) else {"": kind}


def option_names() -> dict[str, tuple[str, ...]]:
    """Returns the names of the options of each group; in a group with choices, those of all its choices."""
    return {group: _names(group in KINDS, *choices_of(group).values()) for group in GROUPS}  # type: ignore[arg-type]


@cache
def _names(choice: bool, *kinds: type[Group]) -> tuple[str, ...]:
    known = [option.name for kind in kinds for option in fields(kind)]
    return tuple(dict.fromkeys(["name", *known] if choice else known))


def short_name(group: str, name: str) -> str:
    """Returns the name by which messages and help call an option: short, if its group allows that.

    Example:
        >>> short_name("run", "seed"), short_name("task", "name"), short_name("demonstrations", "file")
        ('seed', 'task', 'demonstrations.file')
    """
    if name == "name":
        return group
    return f"{group}.{name}" if group in LONG_ONLY else name


def short_names() -> list[str]:
    """Returns the names of all options that have a short name."""
    names = option_names().items()
    return [short_name(group, name) for group, known in names if group not in LONG_ONLY for name in known]


def chosen(group: str, *values: Nested) -> str:
    """Returns a group's ``name`` (or ``algo``): the first one set in ``values``, or else the default."""
    key = "algo" if group == "hindsight" else "name"
    if name := next(filter(None, (given.get(group, {}).get(key) for given in values)), None):
        return name
    if group == "weights" and (weights := get_algorithm(chosen("hindsight", *values)).weights):
        return weights
    return KINDS[group].default if group in KINDS else getattr(GROUPS[group], key)


def renamed(name: str) -> str:
    """Returns the present name of an option that was renamed or moved; empty for any other name.

    Example:
        >>> renamed("curriculum.window"), renamed("curriculum.order"), renamed("curriculum.stages")
        ('order.window', 'order', '')
        >>> renamed("learner.average_decay")
        'learner.ema_decay'
    """
    group, _, key = name.partition(".")
    names = option_names()
    if now := FORMER_NAMES.get(key or group):
        return f"{group}.{now}" if key else now
    if key not in names.get(group, ()):
        for home in FORMER.get(group, ()):
            if key in (home, *names[home]):
                return home if key == home else f"{home}.{key}"
    return ""


def locate(name: str, *values: Nested) -> tuple[str, str]:
    """Finds the group and the name of an option.

    Args:
        name: short name (``seed``), name with group (``run.seed``), or a group (``task``), which stands for
            its option ``name``. Options of some groups (``demonstrations.file``) have no short name.
        values: Options that are set. If several groups have an option with the short name, the choices made
            in these values decide between the groups; earlier values take precedence.

    Raises:
        ValueError: the option does not exist, or its short name is not unique; the message suggests names.

    Example:
        >>> locate("seed"), locate("learner"), locate("weights.floor")
        (('run', 'seed'), ('learner', 'name'), ('weights', 'floor'))
    """
    names = option_names()
    group, _, key = name.partition(".")
    if group == "task_options" or (group == "options" and key):
        meant = ".".join(["task.options", *([key] if key else [])])
        raise ValueError(f"options of the task are written task.options.NAME=VALUE: {meant}, not {name}")
    if now := renamed(name):
        raise ValueError(f"{name} is called {now} now")
    if key:
        if group not in names:
            home = next((each for each, known in names.items() if group in known and group != "name"), None)
            if home is not None:
                raise ValueError(f"no option {name!r}: {group} is an option of the group {home}")
            raise ValueError(f"no group {group!r}{what_there_is(group, names, 'groups')}")
        if key not in names[group]:
            raise ValueError(f"no option {name!r}{what_there_is(key, names[group], f'options of {group}')}")
        return group, key
    if "name" in names.get(name, []):
        return name, "name"
    if name in names:
        raise ValueError(f"{name} is a group of options: write {name}.{names[name][0]}=..., for instance")
    found = [group for group, known in names.items() if name in known and group not in LONG_ONLY]
    if len(found) > 1:
        having = [g for g in found if g not in KINDS or hasattr(KINDS[g].find(chosen(g, *values)), name)]
        if len(having) > 1:
            written = " or ".join(f"{group}.{name}" for group in having)
            raise ValueError(f"several groups have an option {name!r}: write {written}")
        found = having or found
    if found:
        return found[0], name
    if long := [f"{group}.{name}" for group in LONG_ONLY if name in names[group]]:
        raise ValueError(f"no option {name!r}; did you mean {long[0]}?")
    if name in TASK_OPTIONS:
        raise ValueError(f"{name} is an option of the task: write task.options.{name}=...")
    raise ValueError(f"no option {name!r}{nearest(name, short_names())}; `torchrl-her train -h` lists them")


def split_name(name: str) -> list[str]:
    """Splits a name such as ``task.options.bits`` into an option and, if given, an entry of its mapping.

    Example:
        >>> split_name("run.seed"), split_name("task.options.bits")
        (['run.seed'], ['task.options', 'bits'])
    """
    group, *rest = name.split(".", 2)
    return [".".join([group, *rest[:1]]), *rest[1:]]


def place(values: Mapping[str, Any], base: Nested | None = None) -> Nested:
    """Sorts values, given by short or long names or as whole groups, into groups.

    If several groups have an option with the same short name, the choices in the values and in ``base``
    decide between the groups; such names are therefore placed last. If an option is given several times, the
    last value counts.

    Example:
        >>> place({"task": "hand_v0", "seed": 3, "run": {"epochs": 2}, "task.options.bits": 8})
        {'task': {'name': 'hand_v0', 'options': {'bits': 8}}, 'run': {'seed': 3, 'epochs': 2}}
    """
    placed: Nested = {}
    names = option_names()
    shared = [name for name in values if sum(name in known for known in names.values()) > 1]
    for name, value in sorted(values.items(), key=lambda item: item[0] in shared):
        if not isinstance(name, str):
            raise ValueError(f"options must be names, got {name!r}")
        if name in (*GROUPS, *FORMER) and isinstance(value, Mapping):
            for inner, each in value.items():
                group, key = locate(f"{name}.{inner}")
                placed.setdefault(group, {})[key] = each
            continue
        if value is None and "name" in names.get(name, []):
            continue  # a null name, as in task=null, means the default
        if name == "curriculum" and isinstance(value, list | tuple):
            placed.setdefault("curriculum", {})["stages"] = list(value)
            continue
        option, *entry = split_name(name)
        group, field = locate(option, placed, base or {})
        if entry:
            before = placed.get(group, {}).get(field)
            value = _join(before if isinstance(before, Mapping) else Entries(), {entry[0]: value})
        elif name in shared and field in placed.get(group, {}):
            raise ValueError(f"{name} and {group}.{field} set the same option: give one of them")
        placed.setdefault(group, {})[field] = value
    return placed


def merge(*values: Mapping[str, Any]) -> Nested:
    """Merges several sets of values by group; later values replace earlier ones.

    Example:
        >>> merge({"seed": 1, "epochs": 2}, {"run.seed": 3})
        {'run': {'seed': 3, 'epochs': 2}}
    """
    return reduce(over, map(place, values), {})


def over(below: Nested, above: Nested) -> Nested:
    """Merges two sets of values by group; values of ``above`` replace those of ``below``.

    Example:
        >>> over({"task": {"options": {"bits": 8, "max_steps": 9}}}, place({"task.options.bits": 4}))
        {'task': {'options': {'bits': 4, 'max_steps': 9}}}
    """
    both = {group: dict(values) for group, values in below.items()}
    for group, values in above.items():
        merged = both.setdefault(group, {})
        for name, value in values.items():
            before = merged.get(name)
            keeps = isinstance(value, Entries) and isinstance(before, Mapping)
            merged[name] = _join(before, value) if keeps else value
    return both


def _join(before: Any, entries: Mapping[str, Any]) -> dict[str, Any]:
    joined = {**before, **entries}
    return Entries(joined) if isinstance(before, Entries) else joined
