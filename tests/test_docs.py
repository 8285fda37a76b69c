"""The site of ``docs``: its Python runs, every public name is listed, links lead somewhere."""

from __future__ import annotations

import importlib
import importlib.util
import re
from pathlib import Path
from types import ModuleType

import pytest

DOCS = Path(__file__).parent.parent / "docs"
PACKAGES = ("torchrl_her", "torchrl_her_envs", "torchrl_her_recipes")
PAGES = sorted(path.name for path in DOCS.glob("*.md"))


def blocks(page: str) -> list[str]:
    return re.findall(r"```python\n(.*?)```", (DOCS / page).read_text(), re.DOTALL)


@pytest.fixture(scope="module")
def conf() -> ModuleType:
    spec = importlib.util.spec_from_file_location("docs_conf", DOCS / "conf.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


# The other guides have tests of their own: tests/test_examples.py, tests/envs/test_gym_guide.py.
@pytest.mark.parametrize(("page", "number"), [("index.md", 1), ("own_script.md", 4), ("weights.md", 3)])
def test_a_page_s_python_runs_from_top_to_bottom(page: str, number: int) -> None:
    assert len(blocks(page)) == number
    names: dict[str, object] = {"__name__": page}
    for block in blocks(page):
        exec(compile(block, page, "exec"), names)


@pytest.mark.parametrize("package", PACKAGES)
def test_the_reference_lists_every_public_name_once(package: str) -> None:
    text = (DOCS / "api" / f"{package}.rst").read_text()
    assert f".. currentmodule:: {package}\n" in text
    listed = re.findall(r"^\.\. (?:auto\w+|py:data):: (\w+)(?:\(.*\))?$", text, re.MULTILINE)
    assert sorted(listed) == sorted(importlib.import_module(package).__all__)


def test_the_settings_import_without_sphinx_and_name_what_is_there(conf: ModuleType) -> None:
    assert conf.project == "torchrl-her"
    assert all((DOCS / folder).is_dir() for folder in conf.exclude_patterns)
    for file, page in conf.PAGES.items():
        assert (DOCS / page).exists()
        assert (DOCS / file).exists() or (DOCS.parent / file).exists()
        assert conf.link_to_pages(f"[a]({file}#b)") == f"[a]({page}#b)"


@pytest.mark.parametrize("page", PAGES)
def test_pages_are_in_the_contents_and_their_links_and_pictures_are_there(page: str) -> None:
    contents = "\n".join(re.findall(r"```\{toctree\}\n(.*?)```", (DOCS / "index.md").read_text(), re.DOTALL))
    assert page == "index.md" or re.search(f"^{page.removesuffix('.md')}$", contents, re.MULTILINE)
    text = re.sub(r"```python\n.*?```", "", (DOCS / page).read_text(), flags=re.DOTALL)
    for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", text):
        assert (DOCS / target).exists(), target
