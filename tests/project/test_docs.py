"""The site of ``docs``: its Python runs, every public name is listed, links lead somewhere."""

from __future__ import annotations

import importlib
import importlib.util
import re
from pathlib import Path
from types import ModuleType

import pytest

import torchrl_her_recipes

from ..recipes.studies.here import Here
from .pages import DOCS, blocks, run_page, script

PACKAGES = ("torchrl_her", "torchrl_her_envs", "torchrl_her_recipes")
LIBRARY = (
    "goals",
    "replay_buffers",
    "modules",
    "objectives",
    "curriculum",
    "behavior",
    "trainers",
    "native",
    "demonstrations",
)
PAGES = sorted(str(path.relative_to(DOCS)) for path in DOCS.glob("**/*.md"))


@pytest.fixture(scope="module")
def conf() -> ModuleType:
    return script("docs/conf.py")


# The other guides have tests of their own: below, test_examples.py, test_extending.py, test_gym_guide.py.
@pytest.mark.parametrize(
    ("page", "number"),
    [
        ("callbacks.md", 3),
        ("choosing.md", 1),
        ("demonstrations.md", 4),
        ("devices.md", 1),
        ("from_torchrl.md", 2),
        ("index.md", 1),
        ("learners.md", 3),
        ("loggers.md", 2),
        ("normalization.md", 2),
        ("novelty.md", 4),
        ("replay_buffers.md", 6),
        ("weights.md", 3),
    ],
)
def test_a_page_s_python_runs_from_top_to_bottom(
    page: str, number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    run_page(page, number)


def test_hindsight_is_configured_by_hydra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("hydra")
    monkeypatch.chdir(tmp_path)
    (config,) = blocks("hydra.md", "yaml")
    Path("hindsight.yaml").write_text(config)
    run_page("hydra.md", 1)


def test_a_policy_is_exported_loaded_and_played_by_onnxruntime(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("onnx", "onnxruntime", "onnxscript"):
        pytest.importorskip(name, reason="needs the extra onnx")
    monkeypatch.chdir(tmp_path)
    run_page("export.md", 3)
    assert Path("hand_v1.md").exists()


def test_options_are_searched_for_as_the_guide_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("optuna", reason="needs the extra tune")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(torchrl_her_recipes, "make_workers", lambda **_options: Here())
    names = run_page("tuning.md", 3)
    assert Path("runs/tune/best.yaml").exists()
    assert names["best"] in names["scores"]
    assert len(names["study"].trials) == 2


def test_the_own_script_trains_and_measures_what_it_has_learned() -> None:
    shorter = {"total_frames = 0, 200_000": "total_frames = 0, 800", "% 20_000": "% 800"}
    ((frames, success),) = run_page("own_script.md", 4, shorter=shorter)["curve"]
    assert frames == 800
    assert 0.0 <= success <= 1.0


def listed(package: str) -> dict[str, list[str]]:
    """The names that the reference of a package lists, by the module that they are said to be in."""
    text = (DOCS / "api" / f"{package}.rst").read_text()
    names: dict[str, list[str]] = {}
    module = ""
    directive = r"^\.\. (currentmodule|auto\w+|py:data):: ([\w.]+)(?:\(.*\))?$"
    for kind, name in re.findall(directive, text, re.MULTILINE):
        if kind == "currentmodule":
            module = name
        else:
            names.setdefault(module, []).append(name)
    return names


@pytest.mark.parametrize("package", PACKAGES)
def test_the_reference_lists_every_public_name_once(package: str) -> None:
    assert sorted(listed(package)[package]) == sorted(importlib.import_module(package).__all__)


def test_the_reference_lists_what_the_library_s_sub_packages_have_beside_its_front() -> None:
    names, front = listed("torchrl_her"), set(importlib.import_module("torchrl_her").__all__)
    assert set(names) == {"torchrl_her", *(f"torchrl_her.{name}" for name in LIBRARY)}
    for name in LIBRARY:
        own = set(importlib.import_module(f"torchrl_her.{name}").__all__)
        assert sorted(names[f"torchrl_her.{name}"]) == sorted(own - front)


def test_the_map_of_the_repository_names_its_folders() -> None:
    table = (DOCS / "index.md").read_text()
    named = re.findall(r"^\| ((?:`[\w/]+`(?:, )?)+) \|", table, re.MULTILINE)
    folders = [folder for row in named for folder in re.findall(r"`([\w/]+)`", row)]
    assert all((DOCS.parent / folder).is_dir() for folder in folders)
    for package in ("torchrl_her", "envs/torchrl_her_envs", "recipes/torchrl_her_recipes"):
        parts = {path.parent.name for path in (DOCS.parent / package).glob("*/__init__.py")}
        mapped = {
            folder.removeprefix(f"{package}/") for folder in folders if folder.startswith(f"{package}/")
        }
        assert parts <= mapped


def test_the_comparison_names_tests_that_there_are() -> None:
    named = re.findall(r"`(test_\w+)`", (DOCS / "comparison.md").read_text())
    assert len(named) > 8
    tests = "\n".join(path.read_text() for path in (DOCS.parent / "tests").rglob("test_*.py"))
    for name in named:
        assert f"def {name}(" in tests, name


def test_equations_are_typeset(conf: ModuleType) -> None:
    assert {"amsmath", "dollarmath"} <= set(conf.myst_enable_extensions)
    for page in PAGES:
        text = re.sub(r"```.*?```", "", (DOCS / page).read_text(), flags=re.DOTALL)
        assert text.count("$$") % 2 == 0, page
        assert len(re.findall(r"(?<!\$)\$(?!\$)", re.sub(r"`[^`]*`", "", text))) % 2 == 0, page


def test_the_settings_import_without_sphinx_and_name_what_is_there(conf: ModuleType) -> None:
    assert conf.project == "torchrl-her"
    assert all((DOCS / folder).is_dir() for folder in conf.exclude_patterns)
    for file, page in conf.PAGES.items():
        assert (DOCS / page).exists()
        assert (DOCS / file).exists() or (DOCS.parent / file).exists()
        assert conf.link_to_pages(f"[a]({file}#b)") == f"[a]({page}#b)"


@pytest.mark.parametrize("page", PAGES)
def test_pages_are_in_the_contents_and_their_links_and_pictures_are_there(
    page: str, conf: ModuleType
) -> None:
    everything = "\n".join((DOCS / each).read_text() for each in PAGES)
    contents = "\n".join(re.findall(r"```\{toctree\}\n(.*?)```", everything, re.DOTALL))
    in_contents = re.search(f"^{page.removesuffix('.md')}$", contents, re.MULTILINE) is not None
    assert in_contents == (page != "index.md" and page.split("/")[0] not in conf.exclude_patterns)
    text = re.sub(r"```python\n.*?```", "", (DOCS / page).read_text(), flags=re.DOTALL)
    for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", text):
        assert ((DOCS / page).parent / target).exists(), target
