"""Converts plain values to the types of options, and names to the objects that they refer to."""

from __future__ import annotations

from contextlib import suppress
from importlib import import_module
from numbers import Integral, Real
from typing import Any

from torchrl_her_recipes.config.plain_files import shown


def as_kind(name: str, value: object, kind: type) -> Any:
    """Converts a value to the type of an option.

    Text that spells a number is accepted for an option that is a number.

    Example:
        >>> as_kind("learning_rate", "1e-3", float), as_kind("epochs", 2.0, int)
        (0.001, 2)
    """
    if kind in (str, bool):
        if isinstance(value, kind):
            return value
    elif isinstance(value, str | Real) and not isinstance(value, bool):
        with suppress(ValueError, OverflowError):
            number = value if isinstance(value, Integral) else float(value)
            if kind is float or number == int(number):
                return kind(number)
    words = {str: "text", bool: "true or false", int: "a whole number", float: "a number"}
    raise ValueError(f"{name} must be {words[kind]}, got {shown(value)}")


def load_name(path: str) -> Any:
    """Imports a module and returns one of its attributes, given as ``module:attribute``.

    Example:
        >>> load_name("math:floor")(2.5)
        2
    """
    module, _, name = path.partition(":")
    try:
        return getattr(import_module(module), name)
    except (AttributeError, ModuleNotFoundError) as error:
        raise ValueError(f"{path!r} must name an attribute of a module, as module:name: {error}") from error
