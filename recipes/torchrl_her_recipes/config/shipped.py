"""Names of the presets and trained policies that come with the package."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from torchrl_her_recipes.config.options import what_there_is
from torchrl_her_recipes.config.plain_files import naming, read_mapping, shown
from torchrl_her_recipes.config.policy_header import POLICY_SUFFIX, read_header
from torchrl_her_recipes.config.shortcuts import merge, place

CONF = Path(__file__).parent.parent / "conf"
_TRAINED = Path(__file__).parent.parent / "trained"


def preset_names() -> list[str]:
    """Returns the names of all presets that come with the package."""
    return sorted(path.stem for path in (CONF / "preset").glob("*.yaml"))


def load_preset(name: str) -> dict[str, Any]:
    """Returns the values of a preset, by the names of options.

    A preset may begin with another one, ``preset: demo``, whose values hold where it has none of its own.

    Args:
        name: one of ``preset_names()``, or the path of a YAML file.

    Raises:
        ValueError: there is no such preset, or it begins with itself.
    """
    return _load(name, ())


def _load(name: str, above: tuple[Path, ...]) -> dict[str, Any]:
    path = _path(name)
    if path in above:
        raise ValueError(f"the preset {name!r} begins with itself")
    values = read_mapping(path)
    first = values.pop("preset", None)
    with naming(path):
        place(values)  # unknown names
        if first is not None:
            _path(first)
    return values if first is None else merge(_load(first, (*above, path)), values)


def preset_summary(name: str) -> str:
    """Returns the purpose of a preset in one line: the comment that its file begins with."""
    first, *_ = [*_path(name).read_text().splitlines(), ""]
    return first.lstrip("# ") if first.startswith("#") else ""


def _path(name: str) -> Path:
    path = Path(name) if str(name).endswith((".yaml", ".yml")) else CONF / "preset" / f"{name}.yaml"
    if "\0" in str(name) or not path.is_file():
        raise ValueError(f"there is no preset {shown(name)}{what_there_is(name, preset_names(), 'presets')}")
    return path


def policy_files() -> dict[str, Path]:
    """Returns the files of the policies that come with the package, by their names."""
    return {path.stem: path for path in sorted(_TRAINED.glob(f"*{POLICY_SUFFIX}"))}


def policy_path(name: str) -> Path | None:
    """Returns the file of the packaged policy of this name or of this task; None if there is none.

    Example:
        >>> policy_path("gym:FetchPush-v4").name
        'fetch_push.safetensors'
    """
    files = policy_files()
    plays = (path for path in files.values() if read_header(path)["info"]["task"] == name)
    return files.get(name) or next(plays, None)
