"""The report of a study: numbers worked out by hand, what is missing, and a page that stands by itself."""

from __future__ import annotations

import csv
import re
import sys
from collections.abc import Sequence
from dataclasses import asdict
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from torchrl_her_recipes.cli import main
from torchrl_her_recipes.comparing import ALL_TASKS, Verdict, compare, judge
from torchrl_her_recipes.goal_map import GoalMap
from torchrl_her_recipes.intervals import bootstrap, interquartile_means
from torchrl_her_recipes.report import write_report
from torchrl_her_recipes.studies import Study, load_study, study_names
from torchrl_her_recipes.study_results import at_the_end, read_combinations
from torchrl_her_recipes.thesis import Order, Thesis, load_thesis

TASKS, ALGORITHMS = ["hand_v2", "robot_v2"], ["her", "filtered_her"]
RECIPE: dict[str, Any] = {"epochs": 3, "epoch_frames": 1_000, "num_runs": 4}
STUDY = Study(name="bias", summary="small", recipe=RECIPE, vary={"task": TASKS, "algo": ALGORITHMS})
CHAPTERS = ("ibs", "bias", "curriculum", "window", "initialisation")
VOID = {"area", "base", "br", "col", "hr", "img", "input", "link", "meta", "source"}


def write_run(folder: Path, study: Study, label: str, success: Sequence[float], *, epochs: int = 3) -> None:
    """The folder that a batch of runs leaves behind, a constant success for each run."""
    recipe = dict(study.cells())[label]
    home = folder / label
    home.mkdir(parents=True)
    (home / "config.yaml").write_text(yaml.safe_dump(asdict(recipe)))
    rows = [
        {
            "run": run,
            "seed": run,
            "epoch": epoch,
            "frames": 1_000 * epoch,
            "seconds": 60.0 * epoch,
            "success": value,
            "distance": 1.0 - value,
            "kl": 2.0 if recipe.algo == "her" else 0.5,
            "q": -10.0,
            "return": -30.0,
            "q_bias": 20.0,
            "rows_real_positive": 10 * epoch,
            "rows_virtual_positive": 100 * epoch,
            "rows_useful_virtual_positive": 50 * epoch,
        }
        for epoch in range(1, epochs + 1)
        for run, value in enumerate(success)
    ]
    with open(home / "metrics.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    GoalMap(np.ones((len(success), 4, 4)), np.full((4, 4), 1 / 16)).save(home / "goal_map.npz")
    (home / "policy.pt").touch()


@pytest.fixture(scope="module")
def unfinished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a study, a quarter of which is missing and another not at its end; and its report."""
    folder = tmp_path_factory.mktemp("runs")
    write_run(folder, STUDY, "hand_v2_her", [0.0, 0.1, 0.3, 0.9])
    write_run(folder, STUDY, "hand_v2_filtered_her", [0.5, 0.7, 0.9, 1.0])
    write_run(folder, STUDY, "robot_v2_her", [0.25, 0.25, 0.25, 0.25], epochs=2)
    own = folder / "bias.yaml"
    about = {"summary": "a <small> one", "recipe": RECIPE, "vary": STUDY.vary}
    own.write_text(yaml.safe_dump(about, sort_keys=False))
    assert main(["report", str(own), "--folder", str(folder)]) == 0
    return folder


@pytest.fixture(scope="module")
def page(unfinished: Path) -> str:
    return (unfinished / "report" / "index.html").read_text()


def table(path: Path) -> list[dict[str, str]]:
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def text_of(page: str) -> str:
    """What a reader sees."""
    return " ".join(re.sub(r"<[^>]+>", " ", page.split("</style>")[1]).split())


# numbers


def test_a_run_s_number_at_the_end_is_the_mean_of_its_last_three_evaluations() -> None:
    rows = [{"run": run, "success": value + run} for value in (9.0, 0.0, 1.0, 5.0) for run in (1, 0)]
    assert at_the_end(rows, "success") == [2.0, 3.0]
    assert at_the_end(rows, "success", evaluations=1) == [5.0, 6.0]


def test_interquartile_means_leave_out_a_quarter_at_either_end() -> None:
    means = interquartile_means([[0.0, 0.1, 0.3, 0.9], [0.5, 0.7, 0.9, 1.0], [5.0, 1.0, 3.0, 2.0, 90.0]])
    assert means.tolist() == pytest.approx([0.2, 0.8, 10.0 / 3.0])  # of five, one at either end


def test_a_bootstrap_keeps_to_its_strata() -> None:
    """Runs of one task never stand in for those of another: without strata the mean would move."""
    (mean,), _ = bootstrap([[0.0] * 6, [1.0] * 6], [[0, 1]], repetitions=200)
    assert (mean.value, mean.low, mean.high) == (0.5, 0.5, 0.5)


def test_intervals_hold_the_mean_and_grow_with_the_spread() -> None:
    rng = np.random.default_rng(0)
    narrow, wide = rng.normal(0.5, 0.01, 15), rng.normal(0.5, 0.2, 15)
    (first, second), (gap,) = bootstrap([narrow, wide], [[0], [1]], [(0, 1)], repetitions=500)
    assert first.low < first.value < first.high
    assert 5 * (first.high - first.low) < second.high - second.low
    assert gap.value == pytest.approx(first.value - second.value)
    again, _ = bootstrap([narrow, wide], [[0], [1]], [(0, 1)], repetitions=500)
    assert again == [first, second]


def test_one_run_has_no_interval() -> None:
    (one, two), (gap,) = bootstrap([[0.5], [0.1, 0.3]], [[0], [1]], [(0, 1)], repetitions=50)
    assert (one.value, two.value) == (0.5, 0.2)
    assert np.isnan([one.low, one.high, gap.low, gap.high]).all()
    assert not np.isnan(two.low)


def test_algorithms_at_their_end_everywhere_are_compared_on_all_tasks(tmp_path: Path) -> None:
    write_run(tmp_path, STUDY, "hand_v2_her", [0.1] * 4)
    write_run(tmp_path, STUDY, "hand_v2_filtered_her", [0.5] * 4)
    write_run(tmp_path, STUDY, "robot_v2_her", [0.3] * 4)
    write_run(tmp_path, STUDY, "robot_v2_filtered_her", [0.6] * 4)
    cells = read_combinations(STUDY, tmp_path)
    finals, gaps = compare(cells, "success", Thesis())
    means = {(row.task, row.algorithm): row.iqm for row in finals}
    assert means[ALL_TASKS, "her"] == pytest.approx(0.2)
    assert means[ALL_TASKS, "filtered_her"] == pytest.approx(0.55)
    found = {(row.task, row.first, row.second): row.difference for row in gaps}
    assert found == {
        ("hand_v2", "filtered_her", "her"): pytest.approx(0.4),
        ("robot_v2", "filtered_her", "her"): pytest.approx(0.3),
        (ALL_TASKS, "filtered_her", "her"): pytest.approx(0.35),
    }
    orders = [Order.parse("success", text) for text in ("filtered_her > her", "filtered_her < her")]
    verdicts = {(row.task, row.order): row.verdict for row in judge(cells, orders, gaps)}
    assert [verdicts[task, orders[0].text] for task in (*TASKS, ALL_TASKS)] == [Verdict.APART] * 3
    assert [verdicts[task, orders[1].text] for task in (*TASKS, ALL_TASKS)] == [Verdict.REVERSED] * 3


def test_an_order_within_the_spread_is_undecided_and_its_sign_is_as_written(tmp_path: Path) -> None:
    write_run(tmp_path, STUDY, "hand_v2_her", [0.0, 0.4, 0.6, 1.0])
    write_run(tmp_path, STUDY, "hand_v2_filtered_her", [0.0, 0.5, 0.7, 1.0])
    cells = read_combinations(STUDY, tmp_path)
    _, gaps = compare(cells, "success", Thesis())
    (row, *_) = judge(cells, [Order.parse("success", "her < filtered_her")], gaps)
    assert row.verdict is Verdict.UNDECIDED
    assert row.difference == pytest.approx(-0.1)
    assert row.low < 0 < row.high


# the page


@pytest.mark.parametrize("task", ["treasure_hunt", "gym:torchrl_her/HandThrow-v1"])
def test_tasks_without_a_screen_and_with_odd_names_have_a_page(task: str, tmp_path: Path) -> None:
    study = Study(name="odd", recipe=RECIPE, vary={"task": [task], "algo": ALGORITHMS})
    for label, _ in study.cells():
        write_run(tmp_path / "runs", study, label, [0.1, 0.3, 0.4, 0.9])
    page = write_report(study, tmp_path / "runs", tmp_path / "report").read_text()
    assert task in page
    names = [path.name for path in (tmp_path / "report" / "figures").iterdir()]
    assert any(name.startswith("success_") for name in names)
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
        assert link is not None
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
    assert rows["success", "hand_v2", "her"]["thesis"] == ""
    assert (rows["kl", "hand_v2", "her"]["iqm"], rows["kl", "hand_v2", "her"]["thesis"]) == ("2", "2.0317")
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


# what the thesis says, and what is refused


def test_no_study_of_the_thesis_is_left_out() -> None:
    assert {name for name in study_names() if load_thesis(name).orders} >= set(CHAPTERS)


@pytest.mark.parametrize("name", CHAPTERS)
def test_what_the_thesis_says_is_about_what_the_study_has(name: str) -> None:
    thesis, cells = load_thesis(name), list(load_study(name).cells())
    tasks = {recipe.task for _, recipe in cells}
    assert thesis.orders
    assert {task for own in thesis.numbers.values() for task in own} <= tasks
    labels = {label.removeprefix(f"{recipe.task}_") for label, recipe in cells}
    assert any({order.more, order.less} <= labels for order in thesis.orders)
    assert {order.measure for order in thesis.orders} | set(thesis.numbers) <= set(thesis.where) | {"kl"}


def test_an_order_is_written_in_one_of_two_ways() -> None:
    with pytest.raises(ValueError, match="'a > b' or 'a < b', got 'her = cher'"):
        Order.parse("success", "her = cher")


def test_bad_input_is_one_clear_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    empty = str(tmp_path)
    for arguments, message in {
        ("nothing",): "there is no study 'nothing'; the studies are bias, ",
        ("bias", "--folder", f"{empty}/none"): "none; `torchrl-her study bias` makes its runs",
        ("window", "--folder", empty): f"{empty} has no run of the study window; its runs are window=1, ",
    }.items():
        assert main(["report", *arguments]) == 2
        error = capsys.readouterr().err
        assert message in error
        assert len(error.splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_without_the_extra_its_name_is_in_the_message(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in [name for name in sys.modules if name.startswith("torchrl_her_recipes.report")]:
        monkeypatch.delitem(sys.modules, name)
    for name in ("comparing", "intervals", "study_plots"):
        monkeypatch.delitem(sys.modules, f"torchrl_her_recipes.{name}")
    monkeypatch.setitem(sys.modules, "arch.bootstrap", None)
    assert main(["report", "bias"]) == 2
    assert "reports need the package arch: pip install '.[report]'" in capsys.readouterr().err
