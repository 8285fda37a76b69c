"""Modules of users: they are imported so that the tasks, learners, ... that they register are known."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

_imported: list[str] = []  # worker processes of studies import them, too


def import_modules(names: Sequence[str]) -> None:
    """Imports modules from the current folder or among the installed packages.

    Args:
        names: of the modules, as in an ``import`` statement.

    Raises:
        ValueError: there is no such module, or it cannot be imported.

    Example:
        >>> import_modules(["point_tusk"])
        Traceback (most recent call last):
        ValueError: there is no module 'point_tusk', neither in this folder nor among the installed packages
    """
    here = str(Path.cwd())
    if names and here not in sys.path:
        sys.path.append(here)  # at the end, so that no file in this folder hides an installed package
    for name in names:
        if name.endswith(".py") or not all(part.isidentifier() for part in name.split(".")):
            raise ValueError(f"a module is named as in an import statement, without .py; got {name!r}")
        try:
            import_module(name)
        except (ImportError, SyntaxError, ValueError) as error:
            if isinstance(error, ModuleNotFoundError) and error.name == name:
                raise ValueError(
                    f"there is no module {name!r}, neither in this folder nor among the installed packages"
                ) from error
            raise ValueError(f"the module {name!r} cannot be imported: {error}") from error
        if name not in _imported:
            _imported.append(name)


def imported_modules() -> list[str]:
    """The modules that :func:`import_modules` has imported, in this order."""
    return list(_imported)
