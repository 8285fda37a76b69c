"""Safe reading of files from untrusted sources: text, YAML, JSON and tables.

No content of a file is executed, and files that are too large are refused. If the content is invalid, the
functions raise a ValueError whose message is one line and names the file.
"""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml

_LARGEST = 1 << 20  # largest size of a configuration in bytes
LARGEST_TABLE = 1 << 28
_DEPTH = 30
# Errors that damaged content may raise in any reader. RuntimeError includes torch's and RecursionError.
_DAMAGE = (ArithmeticError, AttributeError, AssertionError, LookupError, RuntimeError, TypeError, ValueError)
_SHOWN = 300  # largest number of characters of an error's text that a message shows


def shown(value: object, most: int = 80) -> str:
    """Formats a value for a message: one line of printable characters, at most ``most`` of them.

    Example:
        >>> shown({"a": "\\x1b[2J"}), shown("x" * 100, 10)
        ("{'a': '\\\\x1b[2J'}", "'xxxxxx...")
    """
    text = repr(value)
    return text if len(text) <= most else f"{text[: most - 3]}..."


def reason(error: BaseException | str) -> str:
    """Formats the message of an error in one line of printable characters and limited length."""
    text = "".join(letter if letter.isprintable() else " " for letter in str(error)[: 10 * _SHOWN])
    text = " ".join(text.split()) or type(error).__name__
    return text if len(text) <= _SHOWN else f"{text[: _SHOWN - 3]}..."


@contextmanager
def naming(path: Path, problem: str = "cannot be read") -> Iterator[None]:
    """Context manager that turns errors about the content of a file into a ValueError naming the file."""
    try:
        yield
    except _DAMAGE as error:
        if type(error).__name__ == "OutOfMemoryError":  # a RuntimeError of torch that is no fault of the file
            raise
        cause = reason(error) if isinstance(error, ValueError) else f"it is damaged ({type(error).__name__})"
        raise ValueError(f"{path} {problem}: {cause}") from error


def read_text(path: Path, *, largest: int = _LARGEST) -> str:
    """Reads the text of a file.

    Raises:
        ValueError: the file has more than ``largest`` bytes, or is not text in UTF-8.
        OSError: the file cannot be read.
    """
    with open(path, "rb") as file:
        data = file.read(largest + 1)
    if len(data) > largest:
        raise ValueError(f"{path} cannot be read: it has more than {largest:,} bytes")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} cannot be read: it is not UTF-8 text") from error


class _Loader(yaml.SafeLoader):
    """YAML loader for plain values of limited depth; refuses aliases, which could expand to huge values."""

    def __init__(self, stream: str) -> None:
        super().__init__(stream)
        self._depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise ValueError("it has an alias (*name); write the value in full")
        self._depth += 1
        if self._depth > _DEPTH:
            raise ValueError(f"it is nested more than {_DEPTH} levels deep")
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node


class _Dumper(yaml.SafeDumper):
    """YAML dumper of text that :class:`_Loader` reads as it was."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


# Numbers such as 1e-3, which YAML 1.1 reads as text unless they are written 1.0e-3.
_SHORT_FLOAT = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$")
for _kind in (_Loader, _Dumper):
    _kind.add_implicit_resolver("tag:yaml.org,2002:float", _SHORT_FLOAT, list("-+.0123456789"))


def parse_yaml(text: str) -> Any:
    """Parses YAML text into plain values.

    Raises:
        ValueError: the text is not YAML, or has an alias (``*name``).

    Example:
        >>> parse_yaml("{a: [1, b, 1e-3]}")
        {'a': [1, 'b', 0.001]}
        >>> parse_yaml("a: &a [1, *a]")
        Traceback (most recent call last):
        ValueError: it has an alias (*name); write the value in full
    """
    try:
        return yaml.load(text, _Loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        problem = ", ".join(part for part in (error.context, error.problem) if part)
        raise ValueError(reason(f"line {mark.line + 1}: {problem}" if mark else problem)) from error
    except yaml.YAMLError as error:
        raise ValueError(reason(error)) from error
    except _DAMAGE as error:
        problem = reason(error) if isinstance(error, ValueError) else f"no value ({type(error).__name__})"
        raise ValueError(problem) from error


def dump_yaml(value: Any, **style: Any) -> str:
    """Formats plain values as YAML that :func:`parse_yaml` reads as it was.

    Args:
        value: plain values.
        **style: arguments of ``yaml.dump``.

    Example:
        >>> dump_yaml({"b": 1, "a": ["1e3", 1e-3]}, default_flow_style=True)
        "{b: 1, a: ['1e3', 0.001]}\\n"
    """
    return yaml.dump(value, Dumper=_Dumper, sort_keys=False, **style)


def read_yaml(path: Path) -> Any:
    """Reads a YAML file and returns its content as plain values."""
    text = read_text(path)
    with naming(path):
        return parse_yaml(text)


def read_mapping(path: Path) -> dict[str, Any]:
    """Reads a YAML file that must hold a mapping from names to values."""
    return _mapping(path, read_yaml(path))


def read_json(path: Path) -> dict[str, Any]:
    """Reads a JSON file that must hold an object."""
    text = read_text(path)
    with naming(path):
        values = json.loads(text)
    return _mapping(path, values)


def _mapping(path: Path, values: Any) -> dict[str, Any]:
    if not isinstance(values, dict) or not all(isinstance(name, str) for name in values):
        raise ValueError(f"{path} cannot be read: it must hold names and values, got {shown(values)}")
    return values


def read_table(path: Path, *, counts: Sequence[str] = ()) -> list[dict[str, float]]:
    """Reads a CSV file of numbers; returns each row as a dict with the names in the file's first line.

    Args:
        path: the file.

    Keyword Args:
        counts: columns that each row must have, with whole numbers of at least 0.
    """
    text = read_text(path, largest=LARGEST_TABLE)
    try:
        rows = [
            {name: number(each) for name, each in row.items()}
            for row in csv.DictReader(text.splitlines(), strict=True)
        ]
    except (AttributeError, TypeError, ValueError, csv.Error) as error:  # missing entries, or not numbers
        raise ValueError(f"{path} is damaged: a line is not a row of the table") from error
    for name in counts:
        if odd := [row.get(name) for row in rows if not isinstance(row.get(name), int)]:
            raise ValueError(f"{path} is damaged: {name} must be a whole number, got {shown(odd[0])}")
    return rows


def number(text: str) -> float:
    """Parses a number: an int if the text consists of digits, else a float."""
    return int(text) if text.isdigit() else float(text)
