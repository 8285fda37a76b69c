"""Pages of single runs, at their end or not."""

from __future__ import annotations

import html
import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from torchrl_her_envs.common.rendering.video import write_video
from torchrl_her_recipes.cli import main
from torchrl_her_recipes.reports import page as page_module

from ..small import Refused
from .small_study import STUDY, write_run
from .test_page import Checker, text_of


@pytest.fixture(autouse=True)
def _quick_pages(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drawing takes seconds, and is tested with the pages of studies."""
    monkeypatch.setattr(page_module, "draw_pictures", lambda cells, finals, figures: {})


def write_epochs(folder: Path, epochs: int, *, done: bool = False) -> Path:
    """The folder of a run that is so far; it has three epochs."""
    home = folder / "hand_v2_her"
    shutil.rmtree(home, ignore_errors=True)
    write_run(folder, STUDY, "hand_v2_her", [0.25, 0.75], epochs=epochs)
    if not done:
        (home / "policy.safetensors").unlink()
    return home


def test_a_run_that_goes_on_and_one_at_its_end(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    home = write_epochs(tmp_path, 2)
    assert main(["report", str(home)]) == 0
    assert capsys.readouterr().out == f"{home}/report/index.html\n"
    page = (home / "report" / "index.html").read_text()
    text = text_of(page)
    assert text.startswith("Run hand_v2_her hand_v2 hand_v2_her 2 of 3 epoch 2 of 3, 2,000 frames")
    assert "success 50 %" in text
    assert "task.name=hand_v2" in text
    assert "thesis" not in text
    assert "<script" not in page
    checker = Checker()
    checker.feed(page)
    assert checker.open == []
    write_epochs(tmp_path, 3, done=True)
    write_video([torch.zeros(8, 8, 3, dtype=torch.uint8)] * 2, home / "play.gif")
    assert main(["report", str(home), "--out", str(tmp_path / "page")]) == 0
    page = (tmp_path / "page" / "index.html").read_text()
    assert "epoch 3 of 3" in text_of(page)
    assert '<img src="data:image/gif;base64,' in page
    assert "The newest film, hand_v2_her/play.gif" in page


def test_several_runs_and_folders_of_runs_share_a_page(tmp_path: Path) -> None:
    for label in ("hand_v2_her", "robot_v2_her"):
        write_run(tmp_path / "sweep", STUDY, label, [0.5])
    page = Path(recipes_page(tmp_path / "sweep", out=tmp_path / "a")).read_text()
    both = Path(recipes_page(*sorted((tmp_path / "sweep").iterdir()), out=tmp_path / "b")).read_text()
    for own in (page, both):
        assert "Runs" in own
        assert re.findall(r'<span class="name">(\w+)</span>', own) == ["hand_v2_her", "robot_v2_her"]


def test_runs_that_differ_in_their_seed_alone_are_one_case(tmp_path: Path) -> None:
    for seed, success in ((0, [0.25, 0.75]), (2, [0.5, 0.5])):
        for gamma in (0.9, 0.95):
            recipe = {**STUDY.recipe, "seed": seed, "num_runs": 2, "gamma": gamma, "epochs": 2}
            own = replace(STUDY, recipe=recipe, vary={"task": ["hand_v2"], "algo": ["her"]})
            write_run(tmp_path / "made", own, "hand_v2_her", success, epochs=2, seed=seed)
            (tmp_path / "sweep").mkdir(exist_ok=True)
            name = f"hand_v2_g{100 * gamma:.0f}_s{seed}"
            (tmp_path / "made" / "hand_v2_her").rename(tmp_path / "sweep" / name)
    page = Path(recipes_page(tmp_path / "sweep", out=tmp_path / "page")).read_text()
    assert re.findall(r'<span class="name">(\w+)</span>', page) == ["hand_v2_g90", "hand_v2_g95"]
    assert "Success at the end (mean of each run's last 2 evaluations)" in html.unescape(page)
    (tmp_path / "made").rmdir()
    shutil.copytree(tmp_path / "sweep" / "hand_v2_g90_s0", tmp_path / "sweep" / "repeated")
    page = Path(recipes_page(tmp_path / "sweep", out=tmp_path / "page")).read_text()
    names = re.findall(r'<span class="name">(\w+)</span>', page)
    assert names[-1] == "repeated"  # its seeds are there already


def recipes_page(*folders: Path, out: Path) -> str:
    assert main(["report", *map(str, folders), "--out", str(out)]) == 0
    return str(out / "index.html")


def test_what_was_not_trained_is_one_line(tmp_path: Path, refused: Refused) -> None:
    home = write_epochs(tmp_path, 1)
    (tmp_path / "empty").mkdir()
    for arguments, message in (
        ([str(tmp_path / "empty")], "empty is no folder of a run: neither it nor a folder"),
        ([str(home), str(tmp_path / "none")], "none is no folder of a run"),
        ([str(home), "--folder", "x"], "--folder goes with the name of a study"),
        ([str(home), "--export", "x"], "--export goes with the name of a study"),
        (["bias", str(home)], "give the name of one study or folders of runs, got bias, "),
        ([str(home), "--follow"], "no option --follow; choose `tensorboard --logdir runs`"),
    ):
        assert message in refused("report", *arguments)
