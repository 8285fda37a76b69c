"""Pages for newcomers: the gallery, and the command line as the program itself describes it."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path
from types import ModuleType

import pytest
from PIL import Image

from torchrl_her_envs.throwing.tasks import TASKS
from torchrl_her_recipes.config.shipped import policy_facts

DOCS = Path(__file__).parents[2] / "docs"


def script(name: str) -> ModuleType:
    """A script of the documentation, as a module."""
    spec = importlib.util.spec_from_file_location(f"docs_{name}", DOCS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_page_on_the_command_line_is_what_the_program_says() -> None:
    made = script("make_command_line").page()
    assert (DOCS / "command_line.md").read_text() == made, "run: python docs/make_command_line.py"
    assert "### Options of `hindsight`" in made
    assert max(map(len, made.splitlines())) <= 110


def test_the_gallery_shows_every_task_with_what_its_policy_achieves() -> None:
    text = (DOCS / "gallery.md").read_text()
    shown = re.findall(r"!\[(\w+)\]\(images/gallery/(\w+)\.gif\)", text)
    assert sorted(shown) == sorted((name, name) for name in TASKS)
    for name, facts in policy_facts().items():
        cells = next(row for row in re.findall(r"(\| !\[.*\n\|.*\n)", text) if f"[{name}]" in row)
        pictures, achieved = (line.strip("| ").split(" | ") for line in cells.splitlines())
        mine = achieved[next(index for index, one in enumerate(pictures) if f"[{name}]" in one)]
        share, _, rest = mine.partition(" %, ")
        assert abs(int(share) / 100 - facts["success"]) < 0.0051, name
        assert rest.endswith(f", {facts['frames']:,} steps"), name


def test_the_films_are_small_and_move() -> None:
    films = sorted((DOCS / "images" / "gallery").glob("*.gif"))
    assert [film.stem for film in films] == sorted(TASKS)
    assert all(film.stat().st_size < 250_000 for film in films)
    for film in films:
        with Image.open(film) as image:
            assert image.n_frames > 5


def test_a_film_is_made_of_a_policy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    gallery = script("make_gallery")
    for name, value in {"GALLERY": tmp_path, "GOALS": 1, "SIZE": 40}.items():
        monkeypatch.setattr(gallery, name, value)
    assert re.fullmatch(r"hand_reach: [01] of 1 goals achieved, \d+ kB", gallery.make_film("hand_reach"))
    assert (tmp_path / "hand_reach.gif").exists()
