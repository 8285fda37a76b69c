"""Plain values from outside: YAML files, and what a field of a recipe may be given."""

from __future__ import annotations

from contextlib import suppress
from numbers import Integral, Real
from pathlib import Path
from typing import Any

import yaml


def read_yaml(path: Path) -> Any:
    """What a YAML file holds.

    Raises:
        ValueError: it is not YAML.
        OSError: it cannot be read.
    """
    try:
        return yaml.safe_load(path.read_text())
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} cannot be read: {' '.join(str(error).split())}") from error


def read_mapping(path: Path) -> dict[str, Any]:
    """What a YAML file of names and values holds.

    Raises:
        ValueError: it is not YAML, or something else.
        OSError: it cannot be read.
    """
    values = read_yaml(path)
    if not isinstance(values, dict) or not all(isinstance(name, str) for name in values):
        raise ValueError(f"{path} cannot be read: it must hold names and values, got {values!r}")
    return values


def as_kind(name: str, value: object, kind: type) -> Any:
    """A value as text, a truth value, a whole number or a number.

    YAML takes ``1e-3`` for text; as a number it is one.

    Args:
        name: of what it is for.
        value: the value.
        kind: str, bool, int or float.

    Raises:
        ValueError: it is something else.

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
    raise ValueError(f"{name} must be {words[kind]}, got {value!r}")
