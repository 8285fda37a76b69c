"""Pages for newcomers: notebooks that run, the gallery, the command line as the program describes it."""

from __future__ import annotations

import inspect
import json
import re
import sys
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from torchrl_her_recipes import make_recipe
from torchrl_her_recipes.components.first_look import resolved
from torchrl_her_recipes.config.policy_header import read_header
from torchrl_her_recipes.config.shipped import policy_files

from .pages import DOCS, run_page, script

NOTEBOOKS = sorted((DOCS / "notebooks").glob("*.ipynb"))


def test_the_page_on_the_command_line_is_what_the_program_says() -> None:
    made = script("docs/make_command_line.py").page()
    assert (DOCS / "command_line.md").read_text() == made, "run: python docs/make_command_line.py"
    assert "### Options of `hindsight`" in made
    assert max(map(len, made.splitlines())) <= 110


def test_the_gallery_shows_every_task_with_what_its_policy_achieves() -> None:
    text = (DOCS / "gallery.md").read_text()
    shown = re.findall(r"!\[(\w+)\]\(images/gallery/(\w+)\.gif\)", text)
    assert sorted(shown) == [(name, name) for name in policy_files()]
    for name, path in policy_files().items():
        facts = read_header(path)["info"]
        cells = next(row for row in re.findall(r"(\| !\[.*\n\|.*\n)", text) if f"[{name}]" in row)
        pictures, achieved = (line.strip("| ").split(" | ") for line in cells.splitlines())
        mine = achieved[next(index for index, one in enumerate(pictures) if f"[{name}]" in one)]
        share, _, rest = mine.partition(" %, ")
        assert abs(int(share) / 100 - facts["success"]) < 0.0051, name
        assert rest.endswith(f", {facts['frames']:,} steps"), name


def test_the_films_are_small_and_move() -> None:
    films = sorted((DOCS / "images" / "gallery").glob("*.gif"))
    assert [film.stem for film in films] == list(policy_files())
    assert all(film.stat().st_size < 250_000 for film in films)
    for film in films:
        with Image.open(film) as image:
            assert image.n_frames > 5


def test_a_film_is_made_of_a_policy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    gallery = script("docs/make_gallery.py")
    for name, value in {"GALLERY": tmp_path, "GOALS": 1, "SIZE": 40}.items():
        monkeypatch.setattr(gallery, name, value)
    assert re.fullmatch(r"hand_reach: [01] of 1 goals achieved, \d+ kB", gallery.make_film("hand_reach"))
    assert (tmp_path / "hand_reach.gif").exists()


def shown(notebook: dict[str, Any]) -> list[list[str]]:
    """What each cell of code shows: kinds of outputs, "image/png" for a picture."""
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    return [
        [next(iter(output.get("data", {output.get("name"): ""}))) for output in cell["outputs"]]
        for cell in cells
    ]


@pytest.mark.long
def test_the_notebooks_run_and_show_the_figures_that_they_are_committed_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("nbclient", reason="needs the extra notebooks")
    for name in ("JUPYTER_RUNTIME_DIR", "JUPYTER_CONFIG_DIR", "JUPYTER_DATA_DIR", "IPYTHONDIR"):
        monkeypatch.setenv(name, str(tmp_path / name.lower()))
    monkeypatch.delenv("MPLBACKEND", raising=False)  # the kernel's own, as when a user runs it
    notebooks, short = script("docs/make_notebooks.py"), tmp_path / "short"
    short.mkdir()
    assert len(NOTEBOOKS) == 3
    for path in NOTEBOOKS:  # each trains for two epochs
        text, epochs = re.subn(r"\bepochs=\d+", "epochs=2", path.read_text())
        assert epochs == 1, path.stem
        (short / path.name).write_text(text)
    monkeypatch.setattr(notebooks, "NOTEBOOKS", short)
    monkeypatch.setattr(sys, "argv", ["make_notebooks.py", "--out", str(tmp_path)])
    notebooks.main()
    for path in NOTEBOOKS:
        notebook = json.loads((tmp_path / path.name).read_text())
        assert shown(notebook) == shown(json.loads(path.read_text())), path.stem
        assert sum(kinds.count("image/png") for kinds in shown(notebook)) >= 3, path.stem


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_small_and_says_nothing_of_a_machine(path: Path) -> None:
    notebook = json.loads(path.read_text())
    assert path.stat().st_size < 300_000
    assert set(notebook["metadata"]) == {"kernelspec", "language_info"}
    assert notebook["metadata"]["kernelspec"]["name"] == "python3"
    for cell in notebook["cells"]:
        assert cell["metadata"] == {}
        assert cell.get("execution_count") is None
        assert all(output.get("execution_count") is None for output in cell.get("outputs", []))
        assert not any(output.get("metadata") for output in cell.get("outputs", []))
        assert "stderr" not in [output.get("name") for output in cell.get("outputs", [])]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_a_page_whose_links_lead_somewhere(path: Path) -> None:
    conf = script("docs/conf.py")
    text = path.read_text()
    source = "\n".join("".join(cell["source"]) for cell in json.loads(text)["cells"])
    links = re.findall(r"\]\(([^)#:\s]+)(?:#[^)]*)?\)", source)
    assert links
    assert all((path.parent / link).exists() for link in links)
    page = conf.notebook_page(text, path.stem)
    pictures = re.findall(r"data:image/png;base64,", page)
    assert len(pictures) == sum(kinds.count("image/png") for kinds in shown(json.loads(text)))
    assert page.startswith("# ")
    for link in re.findall(r"\]\(([^)#:\s]+)(?:#[^)]*)?\)", re.sub(r"```.*?```", "", page, flags=re.DOTALL)):
        assert (path.parent / link).exists(), link  # within docs, too
        assert (path.parent / link).resolve().is_relative_to(DOCS), link
    contents = (DOCS / "index.md").read_text()
    assert re.search(f"^notebooks/{path.stem}$", contents, re.MULTILINE)


@pytest.mark.long
def test_both_programs_of_the_page_for_users_of_stable_baselines3_train(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("stable_baselines3")
    monkeypatch.chdir(tmp_path)
    shorter = {
        "learn(20_000)": "learn(205)",
        "learning_starts=1_000": "learning_starts=200",
        "n_eval_episodes=100": "n_eval_episodes=2",
        "warmup_frames=1_000": "warmup_frames=640",
        "epoch_frames=5_000": "epoch_frames=640",
        "episodes=100,": "episodes=10,",
    }
    names = run_page("from_sb3.md", 2, shorter=shorter)
    assert -50.0 <= names["mean_return"] <= 0.0
    assert 0.0 <= names["success"] <= 1.0


def test_what_the_page_says_of_stable_baselines3_is_so() -> None:
    sb3 = pytest.importorskip("stable_baselines3")
    page = (DOCS / "from_sb3.md").read_text()

    def defaults(kind: type) -> dict[str, Any]:
        return {name: one.default for name, one in inspect.signature(kind).parameters.items()}

    td3 = defaults(sb3.TD3)
    assert (td3["learning_starts"], td3["gamma"], td3["tau"]) == (100, 0.99, 0.005)
    assert (td3["train_freq"], td3["gradient_steps"], td3["learning_rate"]) == (1, 1, 0.001)
    assert (defaults(sb3.SAC)["learning_rate"], defaults(sb3.SAC)["ent_coef"]) == (0.0003, "auto")
    her = defaults(sb3.HerReplayBuffer)
    assert (her["n_sampled_goal"], her["goal_selection_strategy"]) == (4, "future")
    ours = resolved(make_recipe(task="gym:torchrl_her_envs:torchrl_her/HandReach-v0", algo="her"))
    learner = make_recipe(task="hand_v0", algo="her", learner="sac").learner
    assert (ours.learner.gamma, learner.tau, learner.temperature, learner.learning_rate) == (
        0.96,
        0.05,
        0.1,
        0.001,
    )
    assert (ours.collection.warmup_frames, ours.collection.num_envs) == (1000, 8)
    assert ours.collection.frames_per_update == 1
    for words in (
        "at least 1,000, instead of 100",
        "`gamma=0.96` for episodes of 50 steps instead of 0.99",
        "`tau=0.05` instead of 0.005",
    ):
        assert words in page
