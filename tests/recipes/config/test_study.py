"""Studies as values; tests of running them are in ``studies``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from torchrl_her_recipes import Study, load_preset, load_study, study_names
from torchrl_her_recipes.config import imports
from torchrl_her_recipes.config.imports import check_permitted
from torchrl_her_recipes.config.study import curve_label

ROOT = Path(__file__).parents[3]


@pytest.mark.parametrize("name", study_names())
def test_every_study_is_made_of_recipes_that_work_and_can_be_shrunk(name: str) -> None:
    study = load_study(name)
    cells, quick = (dict(own.cells()) for own in (study, load_study(name, quick=True)))
    assert len(cells) > 1
    assert study.summary
    assert all(recipe.run.num_runs >= 3 for recipe in cells.values())
    assert all(curve_label(label, recipe) for label, recipe in cells.items())
    assert quick.keys() == cells.keys()
    assert sum(recipe.total_frames * recipe.run.num_runs for recipe in quick.values()) < 300_000
    two = load_study(name, seeds=2, quick=True).cells()
    assert {recipe.run.num_runs for _, recipe in two} == {2}


def test_frames_are_rounded_up_to_whole_epochs() -> None:
    (_, recipe), *_ = load_study("bias", frames=8_001).cells()
    assert (recipe.run.epochs, recipe.collection.epoch_frames) == (2, 8_000)


def test_some_tasks_have_options_of_their_own(tmp_path: Path) -> None:
    path = tmp_path / "own.yaml"
    path.write_text(
        "recipe: {epochs: 3, k: 2, epoch_frames: 20480}\n"
        "vary: {task: [hand_v0, hand_v1], algo: [her, filtered_her]}\n"
        "for_task:\n  hand_v1: {run: {epochs: 7}}\n"
    )

    def lengths(**options: Any) -> dict[str, int]:
        return {label: own.run.epochs for label, own in load_study(str(path), **options).cells()}

    assert lengths() == {
        "hand_v0_her": 3,
        "hand_v0_filtered_her": 3,
        "hand_v1_her": 7,
        "hand_v1_filtered_her": 7,
    }
    assert {own.hindsight.k for _, own in load_study(str(path)).cells()} == {2}
    assert set(lengths(quick=True).values()) == {2}
    assert set(lengths(frames=30_000).values()) == {2}
    path.write_text(path.read_text().replace("{epochs: 7}", "{epochs: 7}, collection: {epoch_frames: 1000}"))
    assert lengths(frames=30_000)["hand_v1_her"] == 30
    assert {own.run.num_runs for _, own in load_study(str(path), seeds=4).cells()} == {4}


def test_tasks_may_vary_with_their_options() -> None:
    tasks = [{"name": "bit_flip", "options": {"bits": bits}} for bits in (5, 6)]
    study = Study(name="own", vary={"task": tasks}, for_task={"bit_flip": {"epochs": 2}})
    assert [recipe.run.epochs for _, recipe in study.cells()] == [2, 2]


def test_an_option_of_the_task_may_vary_beside_cases_that_set_others() -> None:
    vary = {"task.options.bits": [4, 5]}
    cases = {"plain": {}, "short": {"task.options.max_steps": 3}}
    cells = dict(Study(name="own", recipe={"task": "bit_flip"}, vary=vary, cases=cases).cells())
    options = [recipe.task.options for recipe in cells.values()]
    assert options == [{"bits": 4}, {"bits": 4, "max_steps": 3}, {"bits": 5}, {"bits": 5, "max_steps": 3}]
    with pytest.raises(
        ValueError, match=r"cases of own must not set task.options.bits in one, since it varies"
    ):
        Study(name="own", vary=vary, cases={"one": {"task.options.bits": 6}})


def test_cases_are_crossed_with_what_varies_and_not_with_each_other(tmp_path: Path) -> None:
    path = tmp_path / "own.yaml"
    path.write_text(
        "preset: demo\nvary: {task: [hand_v0, hand_v1]}\nfor_task: {hand_v1: {k: 3}}\n"
        "cases:\n  all_parts: {}\n  no_filter: {algo: unfiltered_cher}\n  one: {k: 1}\n"
    )
    study = load_study(str(path), seeds=2, frames=100)
    cells = dict(study.cells())
    assert list(cells) == [f"hand_v{v}_{case}" for v in (0, 1) for case in ("all_parts", "no_filter", "one")]
    assert [own.hindsight.algo for own in cells.values()] == ["cher_ibs", "unfiltered_cher", "cher_ibs"] * 2
    assert [own.hindsight.k for own in cells.values()] == [4, 4, 1, 3, 3, 1]
    assert {(own.run.num_runs, own.run.epochs) for own in cells.values()} == {(2, 1)}
    assert [curve_label(label, own) for label, own in cells.items()] == ["all_parts", "no_filter", "one"] * 2
    assert list(study.combinations())[1] == {"task": "hand_v0", "case": "no_filter"}


def test_cases_alone_are_enough() -> None:
    cells = dict(Study(name="own", cases={"few": {"k": 1}, "many": {"k": 8}}).cells())
    assert {label: own.hindsight.k for label, own in cells.items()} == {"few": 1, "many": 8}


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"cases": {"plain": {}, "more": {"critics": 5}}}, "more: learner=auto has no option critics"),
        (
            {"cases": {"n": {"action_penalty": 0.0}}, "vary": {"task": ["bit_flip"]}},
            "bit_flip_n: .* no effect with learner=dqn",
        ),
        (
            {"cases": {"w": {"window": 5}}, "vary": {"algo": ["her"]}},
            "her_w: window=5 has no effect with algo",
        ),
        ({"cases": {"a": {}, "b": {"tau": 0.05}}}, "the same run twice: a and b"),
    ],
)
def test_nothing_is_compared_with_itself(values: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        list(Study(name="own", **values).cells())


@pytest.mark.parametrize("path", (ROOT / "docs" / "studies").glob("*.yaml"), ids=lambda path: path.stem)
def test_the_studies_of_the_results_are_made_of_recipes_that_work(path: Path) -> None:
    study = load_study(str(path))
    assert len(dict(study.cells())) == len(list(study.combinations())) > 0


def test_mappings_are_named_by_what_differs() -> None:
    options = [{"bits": 4, "max_steps": 9}, {"bits": 8, "max_steps": 9}]
    study = Study(name="own", recipe={"task": "bit_flip", "algo": "her"}, vary={"task.options": options})
    assert [label for label, _ in study.cells()] == ["bits=4", "bits=8"]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"vary": {}}, "vary of own must hold lists of values by option"),
        ({"cases": {"a/b": {}}}, "cases of own must hold options by name, such as no_filter; got"),
        ({"cases": {"few": 3}}, "cases of own must hold options by name, such as no_filter; got"),
        ({"cases": {"few": {"kk": 3}}}, "no option 'kk'"),
        (
            {"cases": {"few": {"k": 3}}, "vary": {"k": [1, 2]}},
            "cases of own must not set k in few, since it varies",
        ),
        (
            {"cases": {"long": {"run": {"epochs": 3}}}},
            "cases of own set epochs in long: it must not differ by case",
        ),
        ({"vary": {"k": 3}}, "vary of own must hold lists of values by option"),
        ({"vary": {"k": [1]}, "figure": "speed"}, "figure of own must be some of success"),
        ({"vary": {"k": [1, 1]}}, "two combinations that are called k=1"),
        ({"vary": {"kk": [1]}}, "no option 'kk'"),
        (
            {"vary": {"task": ["hand_v0"]}, "for_task": {"hand_v1": {"k": 2}}},
            r"for_task of own must hold options by one of the tasks that vary \(hand_v0\); got",
        ),
        ({"vary": {"k": [1]}, "for_task": {"hand_v1": {}}}, r"the tasks that vary \(none\); got"),
        (
            {"vary": {"task": ["hand_v1"], "k": [1, 2]}, "for_task": {"hand_v1": {"hindsight": {"k": 2}}}},
            "for_task of own must not set k in hand_v1, since it varies",
        ),
    ],
)
def test_mistakes_are_named(values: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        list(Study(name="own", **values).cells())  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("load", "name", "task"),
    [
        (load_study, "defaults", "gym:panda_gym:PandaReach-v3"),
        (load_preset, "panda_stack", "gym:panda_gym:PandaStack-v3"),
    ],
)
def test_files_of_this_package_may_name_modules(
    monkeypatch: pytest.MonkeyPatch, load: Callable[[str], object], name: str, task: str
) -> None:
    monkeypatch.setattr(imports, "_permitted", set())
    with pytest.raises(ValueError, match="would import the module 'panda_gym'"):
        check_permitted(task)
    load(name)
    check_permitted(task)


def test_published_numbers_are_of_what_the_study_has() -> None:
    studies = [study for study in map(load_study, study_names()) if study.published]
    assert studies
    for study in studies:
        cells = {(recipe.task.name, curve_label(label, recipe)) for label, recipe in study.cells()}
        for numbers in study.published.get("numbers", {}).values():
            assert {(task, name) for task, own in numbers.items() for name in own} <= cells, study.name


def test_what_is_no_order_is_refused() -> None:
    for expect, message in (
        ({"success": ["her = cher"]}, "an order is written 'a > b' or 'a < b', got 'her = cher'"),
        ({"success": "her > cher"}, "expect must map metrics to lists of comparisons"),
    ):
        with pytest.raises(ValueError, match=message):
            Study(name="mine", vary={"algo": ["her", "cher"]}, expect=expect)


def test_an_order_of_what_the_study_does_not_have_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("vary: {algo: [her, cher]}\nrecipe: {task: hand_v1}\nexpect: {success: [chre > her]}")
    with pytest.raises(ValueError, match="expect must name combinations, which are her, cher; got 'chre'"):
        load_study(str(path))
