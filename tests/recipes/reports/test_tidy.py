"""The numbers of a study as files: nothing is lost, and reports made of them are the same."""

from __future__ import annotations

import gzip
import math
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import yaml

from torchrl_her_recipes.cli import main
from torchrl_her_recipes.config.study import Study
from torchrl_her_recipes.reports import tidy
from torchrl_her_recipes.reports.results import Combination, read_combinations
from torchrl_her_recipes.reports.tidy import is_results, read_results, read_study, write_files, write_results

from .small_study import RECIPE, STUDY, table, write_run, write_study


@pytest.fixture(scope="module")
def folders(unfinished: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The runs of a study, one of them missing and one not at its end; and the files of their numbers."""
    return unfinished, write_results(STUDY, unfinished, tmp_path_factory.mktemp("results") / "bias")


def combination(label: str, rows: list[dict[str, float]]) -> Combination:
    return Combination(
        label=label,
        task="hand_v1",
        algorithm=label,
        options={"window": 1},
        rows=rows,
        done=True,
        epochs=1,
        planned=1,
        seconds=math.nan,
        differs="",
        goals=None,
    )


def test_reports_from_files_are_those_from_runs(folders: tuple[Path, Path], tmp_path: Path) -> None:
    runs, results = folders
    study, made = str(write_study(tmp_path)), tmp_path / "report"
    assert main(["report", study, "--folder", str(results), "--out", str(made)]) == 0
    reports = (runs / "report", made)
    names = sorted(path.name for path in made.glob("*.csv"))
    assert names == ["curves.csv", "differences.csv", "final.csv", "orders.csv", "runs.csv"]
    for name in names:
        first, second = (table(report / name) for report in reports)
        assert len(first) > 2
        assert first == second
    figures = [{path.name: path for path in (report / "figures").glob("*.png")} for report in reports]
    assert len(figures[0]) > 10
    assert figures[0].keys() == figures[1].keys()
    for name, path in figures[0].items():
        assert path.read_bytes() == figures[1][name].read_bytes(), name


def test_combinations_come_back_as_they_were(folders: tuple[Path, Path]) -> None:
    runs, results = folders
    found = read_results(results)
    assert (found.name, found.summary) == ("bias", "small")
    cells = read_combinations(STUDY, runs)
    assert [cell.label for cell in found.cells] == [cell.label for cell in cells]
    for before, after in zip(cells, found.cells, strict=True):
        for name in (field.name for field in fields(Combination) if field.name not in ("goals", "rows")):
            assert getattr(after, name) == getattr(before, name), (before.label, name)
        assert after.rows == [pytest.approx(row, rel=1e-5) for row in before.rows]
        assert (before.goals is None) == (after.goals is None)
        if before.goals is not None and after.goals is not None:
            assert np.array_equal(after.goals.counts, before.goals.counts)
            assert np.array_equal(after.goals.target, before.goals.target)


def test_the_table_is_tidy(folders: tuple[Path, Path]) -> None:
    rows = table(folders[1] / "runs.csv")
    assert list(rows[0])[:6] == ["label", "task", "algorithm", "seed", "epoch", "frames"]
    assert len(rows) == 4 * 3 + 4 * 3 + 4 * 2
    assert len({(row["label"], row["seed"], row["epoch"]) for row in rows}) == len(rows)
    one = next(row for row in rows if (row["label"], row["seed"], row["epoch"]) == ("hand_v2_her", "3", "2"))
    assert (one["task"], one["algorithm"], one["frames"], one["success"]) == ("hand_v2", "her", "2000", "0.9")


def test_what_made_them_is_written_down(tmp_path: Path) -> None:
    write_run(tmp_path / "runs", STUDY, "hand_v2_her", [0.5])
    home = tmp_path / "runs" / "hand_v2_her"
    (home / "run.json").write_text('{"versions": {"torch": "2.14.1"}}')
    about = yaml.safe_load(
        (write_results(STUDY, str(tmp_path / "runs"), str(tmp_path)) / "about.yaml").read_text()
    )
    assert (about["study"], about["command"]) == ("bias", "torchrl-her study bias")
    assert about["versions"] == {"torch": "2.14.1"}
    assert about["recipe"] == STUDY.recipe
    assert about["vary"] == STUDY.vary
    assert str(about["date"]).startswith("20")
    write_results(STUDY, tmp_path / "runs", tmp_path, command=["one", "two"])
    assert yaml.safe_load((tmp_path / "about.yaml").read_text())["command"] == ["one", "two"]


def test_options_that_are_varied_are_columns(tmp_path: Path) -> None:
    study = Study(
        name="window", recipe={**RECIPE, "task": "hand_v1", "algo": "cher"}, vary={"window": [1, 20]}
    )
    for label, _ in study.cells():
        write_run(tmp_path / "runs", study, label, [0.5, 0.7])
    rows = table(write_results(study, tmp_path / "runs", tmp_path / "results") / "runs.csv")
    assert {(row["label"], row["window"]) for row in rows} == {("window=1", "1"), ("window=20", "20")}


def test_numbers_have_six_digits_and_metrics_that_are_not_there_stay_away(tmp_path: Path) -> None:
    row: dict[str, float] = {"run": 0, "seed": 5, "epoch": 1, "frames": 12_345_678}
    rows = {"a": [{**row, "kl": 1 / 3, "stage": 2}], "b": [{**row, "kl": math.nan, "q": -1e-9}]}
    write_files(
        {"study": "x", "summary": ""}, [combination(name, own) for name, own in rows.items()], tmp_path
    )
    lines = table(tmp_path / "runs.csv")
    assert [lines[0][name] for name in ("frames", "kl", "stage", "q")] == ["12345678", "0.333333", "2", ""]
    first, second = (cell.rows[0] for cell in read_results(tmp_path).cells)
    assert first == {**row, "kl": 0.333333, "stage": 2}
    assert math.isnan(second["kl"])
    assert second.keys() == {*row, "kl", "q"}


def test_large_tables_are_compressed(
    folders: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs, results = folders
    write_results(STUDY, runs, tmp_path)
    monkeypatch.setattr(tidy, "_LARGE", 100)
    write_results(STUDY, runs, tmp_path)
    assert not (tmp_path / "runs.csv").exists()
    assert gzip.decompress((tmp_path / "runs.csv.gz").read_bytes()) == (results / "runs.csv").read_bytes()
    assert [cell.rows for cell in read_results(tmp_path).cells] == [
        cell.rows for cell in read_results(results).cells
    ]
    monkeypatch.undo()
    write_results(STUDY, runs, tmp_path)
    assert not (tmp_path / "runs.csv.gz").exists()  # an old table would be taken for the new one


def test_results_of_another_study_are_refused(folders: tuple[Path, Path]) -> None:
    other = Study(name="ibs", recipe=RECIPE, vary=STUDY.vary)
    with pytest.raises(ValueError, match="holds results of the study bias, not of ibs"):
        read_study(other, folders[1])


def test_damaged_files_are_named(folders: tuple[Path, Path], tmp_path: Path) -> None:
    runs, _ = folders
    with pytest.raises(ValueError, match=r"holds no results: it has no about\.yaml"):
        read_results(tmp_path)
    out = write_results(STUDY, runs, tmp_path)
    assert is_results(out)
    text = (out / "runs.csv").read_text()
    for torn in (
        text[: len(text) // 2].rpartition(",")[0],
        text.replace("hand_v2,her,0", "hand_v2,her,x", 1),
        "",
    ):
        (out / "runs.csv").write_text(torn)
        with pytest.raises(ValueError, match="the table of runs in .* is damaged: "):
            read_results(out)
    (out / "runs.csv").write_text(text)
    (out / "goals.npz").write_bytes((out / "goals.npz").read_bytes()[:100])
    with pytest.raises(ValueError, match=r"goals\.npz is damaged: "):
        read_results(out)
    (out / "goals.npz").unlink()
    (out / "about.yaml").write_text(
        "study: bias\nsummary: none\ncombinations: {hand_v2_her: {task: hand_v2}}\n"
    )
    with pytest.raises(ValueError, match=r"about\.yaml is damaged: 'algorithm' is missing"):
        read_results(out)
    (out / "about.yaml").unlink()
    with pytest.raises(ValueError, match="has no run of the study bias"):
        read_study(STUDY, out)
