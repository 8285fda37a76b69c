"""The walk through the code in ``docs/reading.md``: what it names is there, and what it quotes is true."""

from __future__ import annotations

import importlib
import re
from functools import reduce
from pathlib import Path
from textwrap import dedent, indent

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "docs" / "reading.md").read_text()
LINK = r"\[`([^`]+)`\]\(\.\./([^)]+)\)"
SOURCES = ("envs/", "recipes/")  # folders whose packages are imported by their own name


def module_of(path: str) -> str:
    for folder in SOURCES:
        path = path.removeprefix(folder)
    return path.removesuffix(".py").replace("/", ".")


def test_each_name_is_defined_in_the_file_that_it_links_to() -> None:
    links = [(name, path) for name, path in re.findall(LINK, TEXT) if not name.endswith(path.split("/")[-1])]
    assert len(links) > 25
    for name, path in links:
        module = importlib.import_module(module_of(path))
        found = reduce(getattr, name.split("."), module)
        found = getattr(found, "callback", found)  # of a command
        assert found.__module__ == module.__name__, name


def test_ten_files_are_numbered() -> None:
    numbered = re.findall(rf"^\*\*(\d+)\.\*\* {LINK}", TEXT, re.MULTILINE)
    assert [int(number) for number, _, _ in numbered] == list(range(1, 11))
    assert len({path for _, _, path in numbered}) == 10


def test_code_is_quoted_from_the_file_that_was_linked_before() -> None:
    parts = re.split(r"```python\n(.*?)```", TEXT, flags=re.DOTALL)
    assert len(parts) > 3
    for before, quote in zip(parts[:-1:2], parts[1::2], strict=True):
        _, path = re.findall(LINK, before)[-1]
        code = (ROOT / path).read_text()
        assert any(indent(dedent(quote), " " * width) in code for width in (0, 4, 8)), quote
