"""Reads presets: options of a recipe in a YAML file, on which the user's own options build."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from torchrl_her_recipes.config.imports import permit_task
from torchrl_her_recipes.config.plain_files import naming, read_mapping
from torchrl_her_recipes.config.shipped import find_file, shipped_names
from torchrl_her_recipes.config.shortcuts import merge, place


def load_preset(name: str) -> dict[str, Any]:
    """Returns the values of a preset, by the names of options.

    A preset can extend another preset, named in its entry ``preset``: options that it does not set have the
    values of the other preset.

    Args:
        name: name of a preset that comes with the package, or the path of a YAML file.

    Raises:
        ValueError: there is no such preset, or it extends itself.
    """
    return _load(name, ())


def _load(name: str, above: tuple[Path, ...]) -> dict[str, Any]:
    path = find_file("preset", name)
    if path in above:
        raise ValueError(f"the preset {name!r} extends itself")
    values = read_mapping(path)
    first = values.pop("preset", None)
    with naming(path):
        task = place(values).get("task", {}).get("name", "")  # raises if a name is unknown
        if first is not None:
            find_file("preset", first)
    if name in shipped_names("preset"):
        permit_task(task)  # presets of the package are trusted, so the modules of their tasks are, too
    return values if first is None else merge(_load(first, (*above, path)), values)
