"""Finds presets, search spaces, studies and trained policies that come with the package, by name."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from torchrl_her_recipes.config.options import what_there_is
from torchrl_her_recipes.config.plain_files import naming, read_mapping, shown
from torchrl_her_recipes.config.policy_header import POLICY_SUFFIX, read_header
from torchrl_her_recipes.config.shortcuts import merge, place

CONF = Path(__file__).parent.parent / "conf"
_TRAINED = Path(__file__).parent.parent / "trained"


def shipped_names(kind: str) -> list[str]:
    """Returns the names of the presets, search spaces or studies that come with the package.

    Args:
        kind: ``preset``, ``space`` or ``study``.
    """
    return sorted(path.stem for path in (CONF / kind).glob("*.yaml"))


def find_file(kind: str, name: str) -> Path:
    """Returns the path of a preset, space or study, which is given by its name or as a YAML file.

    Raises:
        ValueError: there is no such file; the message lists the names that come with the package.
    """
    path = Path(name) if str(name).endswith((".yaml", ".yml")) else CONF / kind / f"{name}.yaml"
    if "\0" in str(name) or not path.is_file():
        known = what_there_is(name, shipped_names(kind), "studies" if kind == "study" else f"{kind}s")
        raise ValueError(f"there is no {kind} {shown(name)}{known}")
    return path


def preset_names() -> list[str]:
    """Returns the names of all presets that come with the package."""
    return shipped_names("preset")


def load_preset(name: str) -> dict[str, Any]:
    """Returns the values of a preset, by the names of options.

    A preset can extend another preset, named in its entry ``preset``: options that it does not set have the
    values of the other preset.

    Args:
        name: one of ``preset_names()``, or the path of a YAML file.

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
        place(values)  # raises if a name is unknown
        if first is not None:
            find_file("preset", first)
    return values if first is None else merge(_load(first, (*above, path)), values)


def preset_summary(name: str) -> str:
    """Returns the purpose of a preset in one line: the comment that its file begins with."""
    first, *_ = [*find_file("preset", name).read_text().splitlines(), ""]
    return first.lstrip("# ") if first.startswith("#") else ""


def policy_files() -> dict[str, Path]:
    """Returns the files of the policies that come with the package, by their names."""
    return {path.stem: path for path in sorted(_TRAINED.glob(f"*{POLICY_SUFFIX}"))}


def find_policy(source: str | Path) -> Path:
    """Returns the path of a policy's file; ``source`` is this path, or a name or task of a packaged policy.

    Raises:
        ValueError: there is no such file; the message lists the packaged policies.

    Example:
        >>> find_policy("gym:FetchPush-v4").name
        'fetch_push.safetensors'
    """
    name, files = str(source), policy_files()
    plays = (path for path in files.values() if read_header(path)["info"]["task"] == name)
    path = files.get(name) or next(plays, None) or Path(source)
    if not path.is_file():
        raise ValueError(
            f"{source} is neither the folder of a run, nor the file of an exported policy, nor one of the "
            f"trained policies{what_there_is(name, files, 'trained policies')}"
        )
    return path
