"""Finds files that come with the package by their names: presets, studies, trained policies and so on."""

from __future__ import annotations

from pathlib import Path

from torchrl_her_recipes.config.options import what_there_is
from torchrl_her_recipes.config.plain_files import shown
from torchrl_her_recipes.config.policy_header import POLICY_SUFFIX, read_header

CONF = Path(__file__).parent.parent / "conf"
_TRAINED = Path(__file__).parent.parent / "trained"

# what comes with the package as YAML files, each kind in a folder of its own, and the plural of its name
PLURALS = {
    "preset": "presets",
    "space": "spaces",
    "study": "studies",
    "curriculum": "curricula",
    "symmetry": "symmetries",
}


def shipped_names(kind: str) -> list[str]:
    """Returns the names of the files of a kind that come with the package.

    Args:
        kind: ``preset``, ``space``, ``study``, ``curriculum`` or ``symmetry``.
    """
    return sorted(path.stem for path in (CONF / kind).glob("*.yaml"))


def files_of_options() -> dict[str, list[str]]:
    """Returns the names of the files that options can be set to, by option: presets, curricula and so on."""
    return {kind: shipped_names(kind) for kind in ("preset", "curriculum", "symmetry")}


def find_file(kind: str, name: str, *others: str) -> Path:
    """Returns the path of a file of a kind, which is given by its name or as a YAML file.

    Args:
        kind: as for :func:`shipped_names`.
        name: name of a file that comes with the package, or the path of a YAML file.
        others: what else would be allowed in place of a file, for the message.

    Raises:
        ValueError: there is no such file; the message lists the names that come with the package.
    """
    path = Path(name) if str(name).endswith((".yaml", ".yml")) else CONF / kind / f"{name}.yaml"
    if "\0" in str(name) or not path.is_file():
        known = what_there_is(name, [*others, *shipped_names(kind)], PLURALS[kind])
        raise ValueError(f"there is no {kind} {shown(name)}{known}")
    return path


def file_summary(kind: str, name: str) -> str:
    """Returns the purpose of a file of a kind in one line: the comment that it begins with."""
    first, *_ = [*find_file(kind, name).read_text().splitlines(), ""]
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
