"""Imports modules that the user names, and refuses modules that only a file names.

A recipe can name code, as in ``task=module:function`` or ``task=gym:module:ID``. Such a module is imported if
the user names it: in :func:`~torchrl_her_recipes.make_recipe`, on the command line, or by ``--import``. If
only a file names it, importing needs a permission (``with allow_imports():`` or ``--allow-import``), since
the folder of a run, a policy, a preset or a study may come from somebody else.
"""

from __future__ import annotations

import shlex
import sys
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path

from torchrl_her_envs.registry import GYM, module_of

# ``gym:module:ID`` imports these without permission; ``module:function`` could call any of their functions.
_HARMLESS = ("gymnasium", "gymnasium_robotics", "torchrl_her_envs")

_imported: list[str] = []  # names of modules that worker processes must import, too
_permitted: set[str] = set()
_everything: list[bool] = []  # not empty while all modules are permitted


def import_modules(names: Sequence[str]) -> None:
    """Imports modules, given by name, from the installed packages or the current folder.

    Example:
        >>> import_modules(["point_tusk"])
        Traceback (most recent call last):
        ValueError: there is no module 'point_tusk', neither in this folder nor among the installed packages
    """
    if names:
        look_here()
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
    """Returns the modules that :func:`import_modules` has imported, in this order."""
    return list(_imported)


def look_here() -> None:
    """Makes modules in the current folder importable."""
    folder = str(Path.cwd())
    if folder not in sys.path:
        sys.path.append(folder)  # at the end, so that no file in this folder hides an installed package


def foreign_module(task: str) -> str:
    """Returns the name of the module that a task would import; empty for no module or a harmless one.

    Example:
        >>> foreign_module("gym:my_module:MyEnv-v0"), foreign_module("gym:FetchReach-v4")
        ('my_module', '')
    """
    module = module_of(task)
    return "" if task.startswith(GYM) and module in _HARMLESS else module


def needs_permission(task: str, named: Collection[str] = ()) -> bool:
    """Returns whether a task imports a module that is neither in ``named`` nor imported already.

    Example:
        >>> needs_permission("package.envs:make_env"), needs_permission("package.envs:f", ["package"])
        (True, False)
    """
    module, known = foreign_module(task), (*named, *_imported)
    return bool(module) and not any(f"{module}.".startswith(f"{name}.") for name in known)


def command_line(*words: object, task: str) -> str:
    """Returns a command about a task, quoted for a shell, with the imports and the permission that it needs.

    Example:
        >>> command_line("train", "--resume", "my runs/a", task="package.envs:make_env")
        "torchrl-her train --resume 'my runs/a' --allow-import"
    """
    imports = [word for module in imported_modules() for word in ("--import", module)]
    allowed = ["--allow-import"] if needs_permission(task) else []
    return shlex.join(["torchrl-her", *imports, *map(str, words), *allowed])


def permit_task(task: str) -> None:
    """Permits the import of the module that a task names, until this process ends."""
    if module := foreign_module(task):
        _permitted.add(module)


@contextmanager
def allow_imports() -> Iterator[None]:
    """Context manager that permits the import of any module, even if only a file names it.

    Example:
        >>> with allow_imports():
        ...     check_permitted("downloaded:make_env")
    """
    _everything.append(True)
    try:
        yield
    finally:
        _everything.pop()


def check_permitted(task: str) -> None:
    """Raises a ValueError for a task that would import a module that only a file names.

    Example:
        >>> check_permitted("downloaded:make_env")
        Traceback (most recent call last):
        ValueError: task=downloaded:make_env would import the module 'downloaded', which a file names and not
        you: if you trust it, give --allow-import (in Python: with allow_imports():)
    """
    if not _everything and needs_permission(task, _permitted):
        raise ValueError(
            f"task={task} would import the module {foreign_module(task)!r}, which a file names and not you: "
            "if you trust it, give --allow-import (in Python: with allow_imports():)"
        )
