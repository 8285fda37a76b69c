"""Python on pages of the documentation, and its scripts."""

from __future__ import annotations

import importlib.util
import re
import sys
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"


def blocks(page: str, language: str = "python") -> list[str]:
    """Returns the code of a page, block by block."""
    return re.findall(rf"```{language}\n(.*?)```", (DOCS / page).read_text(), re.DOTALL)


def run_page(page: str, number: int, *, shorter: Mapping[str, str] | None = None) -> dict[str, Any]:
    """Runs the Python of a page from top to bottom.

    Args:
        page: Path of the page in ``docs``.
        number: Number of its blocks.
        shorter: Values that make the page train for seconds, by those that the page has.

    Returns:
        All names that the page defines.
    """
    code = blocks(page)
    assert len(code) == number
    for long, short in (shorter or {}).items():
        assert "".join(code).count(long) == 1, long
        code = [block.replace(long, short) for block in code]
    names: dict[str, Any] = {"__name__": page}
    for block in code:
        exec(compile(block, page, "exec"), names)
    return names


def script(path: str) -> ModuleType:
    """Runs a Python file of the repository, by its path there, as a module."""
    spec = importlib.util.spec_from_file_location(f"script_{Path(path).stem}", ROOT / path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where dataclasses look
    spec.loader.exec_module(module)
    return module
