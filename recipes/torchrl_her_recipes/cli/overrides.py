"""Parses ``NAME=VALUE`` arguments of the command line: VALUE is YAML, or a list of values for a sweep."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from itertools import product
from typing import Any

from torchrl_her_envs.registry import task_names
from torchrl_her_recipes.config.algorithms import ALGORITHMS
from torchrl_her_recipes.config.plain_files import parse_yaml
from torchrl_her_recipes.config.shipped import files_of_options
from torchrl_her_recipes.config.shortcuts import GROUPS, KINDS, locate, split_name

ARGUMENTS = ("preset", "folder")  # arguments that are not options; their values are never parsed as YAML
_OPENING, _CLOSING = "[{(", "]})"


def parse_overrides(arguments: Iterable[str]) -> dict[str, str]:
    """Splits arguments ``NAME=VALUE``, checks the names, and returns the text of each value by its name.

    Raises:
        ValueError: an argument has no ``=`` or no value, no option has its name, or two arguments set the
            same option, even under different names.

    Example:
        >>> parse_overrides(["seed=3", "algo=her,cher"])
        {'seed': '3', 'algo': 'her,cher'}
        >>> parse_overrides(["seed=1", "run.seed=2"])
        Traceback (most recent call last):
        ValueError: seed=1 and run.seed=2 set the same option: give one of them
    """
    texts: dict[str, str] = {}
    before: list[tuple[tuple[str, ...], str]] = []
    for argument in arguments:
        name, equals, value = argument.partition("=")
        if not equals or not name:
            raise ValueError(f"an option is written NAME=VALUE, got {argument!r}{_meant(argument)}")
        if any(not part for part in split_sweep(value)):
            raise ValueError(f"{name} needs a value, got {argument!r}")
        path = _path(name, value)
        for other, earlier in before:
            shared = min(len(path), len(other))
            if path[:shared] == other[:shared]:
                raise ValueError(f"{earlier} and {argument} set the same option: give one of them")
        before.append((path, argument))
        texts[name] = value
    return texts


def _path(name: str, value: str) -> tuple[str, ...]:
    """Returns group, option and, if given, mapping entry that a name refers to."""
    if name in ARGUMENTS or (name in GROUPS and value.startswith("{")):  # {...} sets a whole group
        return (name,)
    option, *entry = split_name(name)
    return (*locate(option), *entry)


def named_values() -> dict[str, Collection[str]]:
    """Returns the names that an option can be set to, by option: tasks, algorithms, presets and so on."""
    return {"task": task_names(), "algo": ALGORITHMS, **KINDS, **files_of_options()}


def _meant(text: str) -> str:
    """Returns a hint if an argument is a known value without its option, as in ``hand_v0``; else ""."""
    option = next((option for option, known in named_values().items() if text in known), None)
    return "" if option is None else f"; did you mean {option}={text}?"


def parse_value(text: str) -> Any:
    """Parses a value as YAML; ``null`` and ``None`` both give None.

    Example:
        >>> parse_value("3"), parse_value("{bits: 8}"), parse_value("gym:FetchReach-v4")
        (3, {'bits': 8}, 'gym:FetchReach-v4')
    """
    if text == "None":
        return None
    try:
        return parse_yaml(text)
    except ValueError as error:
        raise ValueError(f"{text} cannot be read as a value of YAML: {error}") from error


def split_sweep(text: str) -> list[str]:
    """Splits the values of a sweep at the commas that are outside of brackets and quotes.

    Example:
        >>> split_sweep("her,filtered_her"), split_sweep("{bits: 8, useless_action: true}")
        (['her', 'filtered_her'], ['{bits: 8, useless_action: true}'])
    """
    parts, depth, quote = [""], 0, ""
    for letter in text:
        if quote:
            quote = "" if letter == quote else quote
        elif letter in "'\"":
            quote = letter
        depth += (letter in _OPENING) - (letter in _CLOSING) if not quote else 0
        if letter == "," and not depth and not quote:
            parts.append("")
        else:
            parts[-1] += letter
    return parts


def single(arguments: Iterable[str]) -> dict[str, Any]:
    """Returns the values of arguments by name; raises a ValueError if an argument has several values."""
    texts = parse_overrides(arguments)
    for name, text in texts.items():
        if name != "folder" and len(split_sweep(text)) > 1:
            raise ValueError(
                f"{name} must be one value, got {text}; several are a sweep: torchrl-her train -m"
            )
    return _parsed(texts)


def sweep(texts: Mapping[str, str]) -> Iterator[dict[str, Any]]:
    """Yields all combinations of the values in a sweep, as options by name; the last option varies fastest.

    Example:
        >>> list(sweep({"algo": "her,cher", "seed": "0,1"}))[1]
        {'algo': 'her', 'seed': 1}
    """
    for values in product(*map(split_sweep, texts.values())):
        yield _parsed(dict(zip(texts, values, strict=True)))


def _parsed(texts: Mapping[str, str]) -> dict[str, Any]:
    return {name: text if name in ARGUMENTS else parse_value(text) for name, text in texts.items()}
