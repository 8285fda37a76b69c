"""The page of a study: what is on it, what is missing, and that it stands by itself."""

from __future__ import annotations

import re
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest

import torchrl_her_recipes
from torchrl_her_recipes.config.study import Study
from torchrl_her_recipes.reports.page import write_report

from ..small import Refused
from .small_study import ALGORITHMS, RECIPE, table, write_run

VOID = {"area", "base", "br", "col", "hr", "img", "input", "link", "meta", "source"}


@pytest.fixture(scope="module")
def page(unfinished: Path) -> str:
    return (unfinished / "report" / "index.html").read_text()


def text_of(page: str) -> str:
    """What a reader sees."""
    return " ".join(re.sub(r"<[^>]+>", " ", page.split("</style>")[1]).split())


def test_tasks_without_a_screen_and_with_odd_names_have_a_page(tmp_path: Path) -> None:
    tasks = ["treasure_hunt", "gym:torchrl_her/HandThrow-v1"]
    study = Study(name="odd", recipe=RECIPE, vary={"task": tasks, "algo": ALGORITHMS})
    for label, _ in study.cells():
        write_run(tmp_path / "runs", study, label, [0.1, 0.3, 0.4, 0.9])
    page = write_report(study, str(tmp_path / "runs"), str(tmp_path / "report")).read_text()
    assert all(task in page for task in tasks)
    names = {path.name for path in (tmp_path / "report" / "figures").iterdir()}
    assert {"success_treasure_hunt.png", "success_gym_torchrl_her_HandThrow-v1.png"} <= names
    assert not any(name.startswith("goals_") for name in names)


class Checker(HTMLParser):
    """Every element is closed in turn, every picture has words, every table a caption."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.pictures: list[dict[str, str | None]] = []
        self.ids: list[str | None] = []
        self.links: list[str | None] = []

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        own = dict(attributes)
        if tag not in VOID:
            self.open.append(tag)
        if tag == "img":
            self.pictures.append(own)
        self.ids += [own["id"]] if "id" in own else []
        self.links += [own[name] for name in ("href", "src") if name in own]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag, (tag, self.getpos())


def test_the_page_is_well_formed_and_stands_by_itself(page: str) -> None:
    checker = Checker()
    checker.feed(page)
    checker.close()
    assert checker.open == []
    assert page.count("<table>") == page.count("<caption>") > 4
    assert len(checker.pictures) > 10
    assert all(picture["alt"] for picture in checker.pictures)
    assert len(set(checker.ids)) == len(checker.ids)
    for link in checker.links:
        assert link.startswith("data:image/") or link[1:] in checker.ids
    assert not re.search(r"https?:|//\w|url\(|@import|<script", re.sub(r'"data:[^"]*"', "", page))
    assert "a &lt;small&gt; one" in page
    assert len(page) < 5_000_000


def test_what_is_missing_is_named(page: str, unfinished: Path) -> None:
    text = text_of(page)
    assert "2 of 4 combinations are missing or not at their end." in text
    assert "at epoch 2 of 3: robot_v2_her" in text
    assert "missing: robot_v2_filtered_her" in text
    assert "as robot_v2_her is at epoch 2 of 3, robot_v2_filtered_her is missing" in text
    assert "her so far" in text
    runs = table(unfinished / "report" / "runs.csv")
    states = {row["label"]: row["state"] for row in runs}
    assert {float(row["seconds"]) for row in runs if row["state"] == "at its end"} == {180.0}
    assert states["hand_v2_her"] == "at its end"


def test_numbers_and_those_of_the_thesis_stand_side_by_side(page: str, unfinished: Path) -> None:
    out = unfinished / "report"
    rows = {(row["measure"], row["task"], row["algorithm"]): row for row in table(out / "final.csv")}
    assert float(rows["success", "hand_v2", "filtered_her"]["iqm"]) == pytest.approx(0.8)
    assert float(rows["success", "hand_v2", "her"]["iqm"]) == pytest.approx(0.2)
    assert rows["success", "hand_v2", "her"]["published"] == ""
    assert (rows["kl", "hand_v2", "her"]["iqm"], rows["kl", "hand_v2", "her"]["published"]) == ("2", "2.0317")
    assert "filtered_her 0.50 (0.50 to 0.50) 0.34 25 % 17 %" in text_of(page)  # KL, thesis, both beside HER's
    (gap,) = [row for row in table(out / "differences.csv") if row["measure"] == "success"]
    assert (gap["task"], gap["first"], gap["second"]) == ("hand_v2", "filtered_her", "her")
    assert float(gap["difference"]) == pytest.approx(0.6)
    verdicts = {
        (row["measure"], row["task"], row["order"]): row["verdict"] for row in table(out / "orders.csv")
    }
    assert verdicts["kl", "hand_v2", "filtered_her < her"] == "holds, apart"
    assert verdicts["q_bias", "hand_v2", "filtered_her < her"] == "undecided"
    assert verdicts["success", "robot_v2", "filtered_her > her"] == "not known yet"


def test_pictures_and_curves_are_files_too(unfinished: Path) -> None:
    out = unfinished / "report"
    names = {path.name for path in (out / "figures").iterdir()}
    for stem in ("success_hand_v2", "distance_robot_v2", "q_hand_v2", "final_hand_v2", "goals_hand_v2_her"):
        assert {f"{stem}.png", f"{stem}.svg"} <= names
    last = [
        row for row in table(out / "curves.csv") if row["measure"] == "success" and row["frames"] == "3000"
    ]
    assert [float(row["median"]) for row in last] == pytest.approx([0.2, 0.8])


def test_bad_input_is_one_clear_line(tmp_path: Path, refused: Refused) -> None:
    empty, none = str(tmp_path), str(tmp_path / "none")
    for arguments, message in {
        ("nothing",): "there is no study 'nothing'; the studies are bias, ",
        ("bias", "--folder", none): f"there is no folder {none}; `torchrl-her study bias` makes its runs",
        ("window", "--folder", empty): f"{empty} has no run of the study window; its runs are window=1, ",
    }.items():
        assert message in refused("report", *arguments)
    assert not list(tmp_path.iterdir())


def test_without_the_extra_its_name_is_in_the_message(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: Refused
) -> None:
    for name in [name for name in sys.modules if name.startswith("torchrl_her_recipes.report")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.delitem(vars(torchrl_her_recipes), "write_report", raising=False)
    monkeypatch.setitem(sys.modules, "arch.bootstrap", None)
    said = "reports need the package arch: pip install '.[report]'"
    assert said in refused("report", "bias", "--folder", str(tmp_path))
