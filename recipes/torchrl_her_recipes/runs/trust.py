"""Which folders of runs this user's own training has made, so that the modules they name may be imported."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path

from torchrl_her.files.writing import write_text
from torchrl_her_recipes.config.imports import foreign_module


def remember(config: Path, task: str) -> None:
    """Notes that this user has trained the run of a ``config.yaml``; only needed if its task names a module.

    Nothing is noted where the user's state directory cannot be written.
    """
    if not foreign_module(task):
        return
    known = {path: own for path, own in _known().items() if Path(path).is_file()}
    known[str(config.resolve())] = _digest(config)
    try:
        _state_file().parent.mkdir(parents=True, exist_ok=True)
        write_text(_state_file(), json.dumps(known, indent=1) + "\n")
    except OSError:
        pass


def is_own(config: Path) -> bool:
    """Whether this user has trained the run of a ``config.yaml``, at this place and with this content."""
    return _known().get(str(config.resolve())) == _digest(config)


def _state_file() -> Path:
    home = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    return Path(home) / "torchrl-her" / "runs.json"


def _known() -> dict[str, str]:
    """Digests by path."""
    try:
        found = json.loads(_state_file().read_text())
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def _digest(config: Path) -> str:
    return hashlib.sha256(config.read_bytes()).hexdigest()
