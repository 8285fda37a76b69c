"""Defines options of a recipe, with help and allowed values, and checks the values of options."""

from __future__ import annotations

import operator
from collections.abc import Callable
from dataclasses import Field, dataclass, field, fields
from difflib import get_close_matches
from math import isfinite
from typing import Any, ClassVar

from torchrl_her_recipes.config.values import as_kind

_KINDS = {"str": str, "bool": bool, "int": int, "float": float}
_LIMITS = {"at_least": operator.ge, "above": operator.gt, "at_most": operator.le, "below": operator.lt}

Needs = tuple[tuple[str, Callable[[Any], object], str], ...]  # see `Group`
AUTO = "auto"  # the value of an option that is chosen for the task's environment, see `.resolve`


def option(
    default: Any,
    help: str,
    *,
    at_least: float | None = None,
    above: float | None = None,
    at_most: float | None = None,
    below: float | None = None,
    choices: tuple[str, ...] = (),
    infinite: bool = False,
    shown_as: str = "",
) -> Any:
    """Defines an option, as a field of a dataclass that is a group of options.

    Args:
        default: the value that works for most tasks; None if the task or the learner has a default of its
            own; ``AUTO`` if the value is derived from the environment before training begins.
        help: short description, shown by ``torchrl-her train -h``.
        at_least, above, at_most, below: allowed range of a number.
        choices: allowed values; empty to allow any.
        infinite: whether infinity is allowed, for an upper limit that can be switched off.
        shown_as: name of the option in messages, if it differs from the field's name.
    """
    limits = {"at_least": at_least, "above": above, "at_most": at_most, "below": below}
    about = {"help": help, "choices": choices, "infinite": infinite, "shown_as": shown_as}
    return field(default=default, metadata={**about, "limits": limits})


@dataclass(frozen=True, kw_only=True)
class Group:
    """Base class of groups of options; an instance checks its options when it is created.

    Attributes:
        needs: Options that have an effect only with some values of another option. Each entry has the name of
            an option A, a function, and names of other options, separated by spaces. The other options have
            an effect only if the function is true of A's value.
        prefix: Text before the names of the group's options in messages.
    """

    needs: ClassVar[Needs] = ()
    prefix: ClassVar[str] = ""

    def __post_init__(self) -> None:
        """Converts the values of the options to their types, and checks the ranges of the values."""
        for definition in fields(self):
            value = getattr(self, definition.name)
            if definition.default in (None, AUTO) and value == definition.default:
                continue
            long_name = self._shown(definition)
            kind = _KINDS.get(str(definition.type).removesuffix(" | None"))
            if kind is not None:
                value = as_kind(long_name, value, kind)
                object.__setattr__(self, definition.name, value)
            _check_value(definition, long_name, value)

    def idle_options(self) -> dict[str, str]:
        """Returns the options that have no effect, each with the setting that causes it; see ``needs``.

        Example:
            >>> from torchrl_her_recipes.config.groups import CollectionConfig
            >>> CollectionConfig.needs, CollectionConfig(processes=0).idle_options()
            ((('processes', <class 'bool'>, 'sync'),), {'sync': 'with processes=0'})
        """
        idle: dict[str, str] = {}
        long_names = {definition.name: self._shown(definition) for definition in fields(self)}
        for other, has_effect, names in self.needs:
            value = getattr(self, other)
            if other in idle or not has_effect(value):
                text = f"{value:g}" if isinstance(value, float) else str(value).lower()
                for name in names.split():
                    idle.setdefault(name, idle.get(other, f"with {long_names[other]}={text}"))
        return idle

    def _shown(self, definition: Field[Any]) -> str:
        return definition.metadata.get("shown_as") or self.prefix + definition.name


def _check_value(definition: Field[Any], long_name: str, value: Any) -> None:
    choices, limits = definition.metadata.get("choices", ()), definition.metadata.get("limits", {})
    if choices and value not in choices:
        raise ValueError(
            f"{long_name} must be one of {', '.join(choices)}, got {value!r}{nearest(value, choices)}"
        )
    bounds = {name: limit for name, limit in limits.items() if limit is not None}
    if not all(_LIMITS[name](value, limit) for name, limit in bounds.items()):  # NaN fails every test
        allowed = " and ".join(f"{name.replace('_', ' ')} {limit}" for name, limit in bounds.items())
        raise ValueError(f"{long_name} must be {allowed}, got {value}")
    if isinstance(value, float) and not (isfinite(value) or definition.metadata.get("infinite")):
        raise ValueError(f"{long_name} must be finite, got {value}")


REGISTERED = "; to use your own, import the module that registers it: torchrl-her --import MODULE"


def nearest(name: object, known: Any) -> str:
    """Returns the hint "did you mean ...?" for a mistyped name; empty if no known name is similar.

    Example:
        >>> nearest("lerning_rate", ["learning_rate", "gamma"])
        '; did you mean learning_rate?'
    """
    matches = get_close_matches(str(name), list(known), n=1)
    return f"; did you mean {matches[0]}?" if matches else ""


def what_there_is(name: object, known: Any, kind: str) -> str:
    """Returns the end of a message about an unknown name: the most similar known name, and all names.

    Example:
        >>> what_there_is("cherr", ["her", "cher"], "algorithms")
        '; did you mean cher? The algorithms are her, cher'
        >>> what_there_is("sarsa", ["her", "cher"], "algorithms")
        '; the algorithms are her, cher'
    """
    hint = nearest(name, known)
    start = f"{hint} The" if hint else "; the"
    return f"{start} {kind} are {', '.join(known)}"
