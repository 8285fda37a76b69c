"""Searches: what they leave behind, that they go on where they were killed, and what they refuse."""

from __future__ import annotations

import csv
import os
import signal
import time
from pathlib import Path
from shutil import copytree
from typing import Any

import matplotlib
import pytest
from filelock import FileLock
from PIL import Image

from torchrl_her_recipes import RunFolder, load_preset, make_recipe, run_score, search_summary
from torchrl_her_recipes.components.first_look import resolved
from torchrl_her_recipes.studies.jobs import Job, Outcome
from torchrl_her_recipes.tuning import search as search_module
from torchrl_her_recipes.tuning.search import SearchResult

from ..studies.here import Here
from .searches import go_on, is_killed, small_search

optuna = pytest.importorskip("optuna", reason="needs the extra tune")


def table(folder: Path) -> list[dict[str, str]]:
    with open(folder / "trials.csv", newline="") as file:
        return list(csv.DictReader(file))


def states(result: SearchResult) -> list[str]:
    return [trial.state.name.lower() for trial in result.trials]


@pytest.fixture(scope="module")
def _begun(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("searches") / "search"
    go_on(small_search(), folder, 1)
    return folder


@pytest.fixture
def begun(_begun: Path, tmp_path: Path) -> Path:
    """The folder of a search that has done one trial."""
    return copytree(_begun, tmp_path / "search")


def test_a_search_leaves_the_best_as_a_preset_and_more_trials_can_be_added(tmp_path: Path) -> None:
    """Its first trial is the recipe as it is, even outside of the space and though its process dies once."""
    space = {
        "learning_rate": {"kind": "log_float", "low": 1e-5, "high": 1e-4},
        "hidden": {"kind": "choice", "values": [8, 12]},
        "tau": {"kind": "float", "low": 0.01, "high": 0.1},
    }
    search, lines = small_search(space, pruner="none", goal_sources=None), list[str]()
    died = Outcome(error="its process was ended by SIGKILL", died=True)
    first = go_on(search, tmp_path, 2, workers=Actors(trial_0000=[died]), say=lines.append)
    assert [line.split(":")[0] for line in lines] == ["trial 1", "trial 2"]  # trial 1 repeats trial 0
    before = first.trials
    assert len(before) == 2
    assert len(search_summary(first.study)) == 2  # too early for importances
    result = go_on(search, tmp_path, 7, pictures=True)
    assert result.trials[:2] == before
    best = result.study.best_trial
    assert best.value == result.best
    assert search_summary(result.study)[0].startswith(f"trial {best.number}: score {best.value:.0%}  ")
    assert "importance (a guess" in search_summary(result.study)[-1]
    assert "hidden" in search_summary(result.study)[-1]  # importances are of all that is varied

    # Any other trial has to beat the recipe as it is.
    default, *others = rows = table(tmp_path)
    assert RunFolder(tmp_path / "trial_0000").recipe() == resolved(search.recipe)
    assert (default["learning_rate"], default["hidden"], default["tau"]) == ("0.001", "16", "0.05")
    assert {row["hidden"] for row in others} <= {"8", "12"}
    # Training with the preset repeats the best trial.
    recipe = make_recipe(load_preset(str(tmp_path / "best.yaml")))
    (folder,) = (row["folder"] for row in rows if row["trial"] == str(best.number))
    assert RunFolder(tmp_path / folder).recipe() == recipe
    assert run_score(recipe) == best.value
    for name in ("history", "importance", "options"):
        with Image.open(tmp_path / f"{name}.png") as picture:
            assert min(picture.size) > 200
    assert matplotlib.rcParams["axes.facecolor"] == matplotlib.rcParamsDefault["axes.facecolor"]
    left = [path.name for path in tmp_path.iterdir() if path.name != ".lock" and path.is_file()]
    expected = ["best.yaml", "search.db", "search.yaml", "trials.csv"]
    assert sorted(left) == sorted([*expected, "history.png", "importance.png", "options.png"])


@pytest.mark.long
@pytest.mark.parametrize("sampler", ["tpe", "cmaes"])
def test_a_search_that_is_killed_goes_on(tmp_path: Path, sampler: str) -> None:
    search = small_search(sampler=sampler, pruner="halving")
    assert is_killed(search, tmp_path, 4, after=2.0)
    result = go_on(search, tmp_path, 4)
    assert set(states(result)) <= {"complete", "pruned"}
    assert len(table(tmp_path)) == len(result.trials) == 4
    assert len({row["learning_rate"] for row in table(tmp_path)}) == 4  # no values are drawn twice


@pytest.mark.parametrize(("pruner", "ends"), [("median", True), ("none", False)])
def test_trials_that_fall_behind_are_pruned(tmp_path: Path, pruner: str, ends: bool) -> None:
    search = small_search(pruner=pruner)
    go_on(search, tmp_path, 1)
    study = optuna.load_study(study_name="search", storage=f"sqlite:///{tmp_path / 'search.db'}")
    for _ in range(5):  # others that were far better
        values = {f"{epoch}": 1.0 for epoch in range(1, 4)}
        good = optuna.trial.create_trial(
            value=1.0,
            params=study.trials[0].params,
            distributions=study.trials[0].distributions,
            intermediate_values={int(epoch): value for epoch, value in values.items()},
        )
        study.add_trial(good)
    last = go_on(search, tmp_path, 7).trials[-1]
    assert last.state.name == ("PRUNED" if ends else "COMPLETE")
    assert bool(list((tmp_path / f"trial_{last.number:04}").glob("checkpoint*"))) != ends


def test_the_recipe_as_it_is_is_never_pruned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(optuna.trial.Trial, "should_prune", lambda _trial: True)
    assert states(go_on(small_search(), tmp_path, 2)) == ["complete", "pruned"]


def test_a_sampler_whose_package_is_missing_names_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(search_module, "find_spec", lambda _name: None)
    with pytest.raises(ImportError, match=r"--sampler cmaes needs cmaes: pip install '.\[tune\]'"):
        search_module.make_sampler("cmaes", 0)


def test_what_a_search_was_begun_with_is_asked_for_again(begun: Path) -> None:
    for other, said in (
        (small_search(sampler="random"), "a search with --sampler=tpe, not --sampler=random: repeat"),
        (small_search(gamma=0.95), "a search with gamma=0.9, not gamma=0.95: repeat its options"),
        (small_search(RANGE), "a search with space.learning_rate={'kind': 'log_float', .*, not space.learn"),
    ):
        with pytest.raises(ValueError, match=said):
            go_on(other, begun, 1)
    (begun / "search.yaml").write_text("sampler: tpe")
    with pytest.raises(ValueError, match="search.yaml cannot be read: it is damaged"):
        go_on(small_search(), begun, 1)


RANGE = {"learning_rate": {"kind": "float", "low": 1e-4, "high": 1e-2}}


def test_one_process_at_a_time_searches_in_a_folder(tmp_path: Path) -> None:
    with (
        FileLock(tmp_path / ".lock"),
        pytest.raises(ValueError, match=f"another process is searching in {tmp_path}"),
    ):
        go_on(small_search(), tmp_path, 1)


class Actors(Here):
    """Play workers whose processes end in some way for some trials."""

    def __init__(self, **outcomes: Any) -> None:
        super().__init__()
        self.outcomes, self.began = outcomes, list[str]()

    def run(self, job: Job) -> Outcome:
        self.began.append(job.label)
        outcome = self.outcomes.get(job.label)
        if isinstance(outcome, list):
            outcome = outcome.pop(0) if outcome else None
        return outcome or super().run(job)


def test_a_trial_whose_process_dies_is_taken_up_again_and_one_that_fails_is_not(tmp_path: Path) -> None:
    died, failed = Outcome(error="its process was ended by SIGKILL", died=True), Outcome(error="why")
    # Trials 1 and 2 repeat trial 0 in its folder.
    workers = Actors(trial_0000=[died, died], trial_0003=failed, trial_0004=[died, died, died])
    result = go_on(small_search(), tmp_path, 3, workers=workers)
    assert states(result) == ["complete", "fail", "fail"]
    assert list(result.failed.values()) == ["why", "its process was ended by SIGKILL"]
    assert workers.began.count("trial_0000") == 3
    again = go_on(small_search(), tmp_path, 3)
    assert again.failed == result.failed


class Pressed(Here):
    """Play workers at whose first trial somebody presses Ctrl-C."""

    def __init__(self) -> None:
        super().__init__()
        self.stopped = False

    def run(self, job: Job) -> Outcome:
        if not self.stopped:
            os.kill(os.getpid(), signal.SIGINT)
            while not self.stopped:
                time.sleep(0.01)
        return Outcome(interrupted=True)

    def stop(self) -> None:
        self.stopped = True


def test_ctrl_c_ends_a_search_that_goes_on_with_the_same_trials(tmp_path: Path) -> None:
    result = go_on(small_search(), tmp_path, 2, workers=Pressed())
    assert result.interrupted
    assert result.trials == []
    (cut,) = (trial for trial in result.study.trials if "repeated" in trial.user_attrs)
    again = go_on(small_search(), tmp_path, 2)
    assert not again.interrupted
    assert states(again) == ["complete"] * 2
    assert again.trials[0].params == cut.params


def test_a_full_disk_ends_a_search_in_one_line_and_loses_nothing(
    begun: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_arguments: object, **_options: object) -> None:
        raise optuna.exceptions.StorageInternalError("while writing") from OSError("no space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(optuna.Study, "tell", full)
        with pytest.raises(OSError, match=r"search.db cannot be used \(no space left on device\); to resume"):
            go_on(small_search(), begun, 2)
    assert states(go_on(small_search(), begun, 2)) == ["complete"] * 2


def test_a_search_that_only_fails_ends(tmp_path: Path) -> None:
    workers = Actors(**{f"trial_{number:04}": Outcome(error="why") for number in range(50)})
    result = go_on(small_search(), tmp_path, None, workers=workers)
    assert len(result.failed) == 5
    assert result.best is None


def test_no_trial_begins_when_the_time_is_up(tmp_path: Path) -> None:
    result = go_on(small_search(), tmp_path, None, minutes=1e-9)
    assert result.trials == []
    with pytest.raises(ValueError, match="minutes must be above 0, got 0"):
        go_on(small_search(), tmp_path, None, minutes=0)
    with pytest.raises(ValueError, match="trials must be at least 1, got 0"):
        go_on(small_search(), tmp_path, 0)


def test_what_is_no_database_is_named(tmp_path: Path) -> None:
    (tmp_path / "search.db").write_bytes(b"no database at all" * 100)
    with pytest.raises(OSError, match="search.db cannot be used .*file is not a database"):
        go_on(small_search(), tmp_path, 1)
