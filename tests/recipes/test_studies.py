"""Studies: what they run, that they go on where they stopped, and what they refuse."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from PIL import Image

from torchrl_her_recipes.cli import main
from torchrl_her_recipes.run_folder import RunFolder
from torchrl_her_recipes.studies import Study, is_done, load_study, run_study, study_names

from .small import SMALL


@pytest.mark.parametrize("name", study_names())
def test_every_study_is_made_of_recipes_that_work_and_can_be_shrunk(name: str) -> None:
    cells = dict(load_study(name).cells())
    assert len(cells) >= 3
    assert all(recipe.num_runs >= 5 for recipe in cells.values())
    quick = dict(load_study(name, quick=True).cells())
    assert quick.keys() == cells.keys()
    assert sum(recipe.total_frames * recipe.num_runs for recipe in quick.values()) < 300_000


def test_seeds_and_frames_take_the_place_of_the_study_s() -> None:
    recipe = next(recipe for _, recipe in load_study("ibs_v0", seeds=3, frames=20_000).cells())
    assert recipe.num_runs == 3
    assert recipe.total_frames == 24_000  # whole epochs of 8,000


def test_a_study_of_ones_own_runs_skips_what_is_done_and_draws(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(
        yaml.safe_dump({"recipe": {**SMALL, "task": "hand_v0"}, "vary": {"algo": ["her", "ddpg"]}})
    )
    folder = tmp_path / "runs"
    command = ["study", str(path), "--folder", str(folder), "--seeds", "2"]
    assert main(command) == 0
    out = capsys.readouterr().out
    assert "2 batched runs to go, 12,800 environment steps in all" in out
    with Image.open(folder / "mine.png") as picture:
        assert min(picture.size) > 200
    metrics = {name: (folder / name / "metrics.csv") for name in ("her", "ddpg")}
    before = {name: file.stat().st_mtime_ns for name, file in metrics.items()}
    assert main(command) == 0
    assert "0 batched runs to go, 0 environment steps" in capsys.readouterr().out
    assert {name: file.stat().st_mtime_ns for name, file in metrics.items()} == before


def test_a_combination_that_was_cut_short_goes_on(tmp_path: Path) -> None:
    short = Study(name="cut", recipe={**SMALL, "epochs": 1}, vary={"algo": ["her"]})
    run_study(short, tmp_path, progress=False)
    home = RunFolder(tmp_path / "her")
    home.config.write_text(home.config.read_text().replace("epochs: 1", "epochs: 2"))
    assert not is_done(home)
    run_study(
        Study(name="cut", recipe={**SMALL, "epochs": 2}, vary={"algo": ["her"]}), tmp_path, progress=False
    )
    assert is_done(home)
    assert [row["epoch"] for row in home.rows()] == [1, 2]


def test_other_options_under_the_same_name_are_refused(tmp_path: Path) -> None:
    run_study(
        Study(name="one", recipe={**SMALL, "epochs": 1}, vary={"algo": ["her"]}), tmp_path, progress=False
    )
    other = Study(name="one", recipe={**SMALL, "epochs": 1, "k": 2}, vary={"algo": ["her"]})
    with pytest.raises(ValueError, match="holds a run with other options"):
        run_study(other, tmp_path, progress=False)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nothing"], "there is no study 'nothing'; the studies are curriculum, ibs_v0"),
        (["ibs_v0", "--seeds", "0"], "seeds must be at least 1, got 0"),
        (["ibs_v0", "--frames", "-5"], "frames must be at least 1, got -5"),
    ],
)
def test_bad_input_is_one_clear_line(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["study", *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert len(error.splitlines()) == 1
