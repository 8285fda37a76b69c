"""Studies as values; tests of running them are in ``studies``."""

from __future__ import annotations

import pytest

from torchrl_her_recipes import Study, load_study, study_names
from torchrl_her_recipes.config.study import curve_label


@pytest.mark.parametrize("name", study_names())
@pytest.mark.parametrize("quick", [False, True])
def test_every_study_is_made_of_recipes_that_work(name: str, quick: bool) -> None:
    study = load_study(name, seeds=2, quick=quick)
    cells = dict(study.cells())
    assert len(cells) > 1
    assert study.summary
    assert {recipe.run.num_runs for recipe in cells.values()} == {2}
    assert all(curve_label(label, recipe) for label, recipe in cells.items())


def test_frames_are_rounded_up_to_whole_epochs() -> None:
    (_, recipe), *_ = load_study("bias", frames=8_001).cells()
    assert (recipe.run.epochs, recipe.collection.epoch_frames) == (2, 8_000)


def test_mappings_are_named_by_what_differs() -> None:
    options = [{"bits": 4, "max_steps": 9}, {"bits": 8, "max_steps": 9}]
    study = Study(name="own", recipe={"task": "bit_flip", "algo": "her"}, vary={"task.options": options})
    assert [label for label, _ in study.cells()] == ["bits=4", "bits=8"]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"vary": {}}, "vary of own must hold lists of values by option"),
        ({"vary": {"k": 3}}, "vary of own must hold lists of values by option"),
        ({"vary": {"k": [1]}, "figure": "speed"}, "figure of own must be times, or some of success"),
        ({"vary": {"k": [1, 1]}}, "two combinations that are called k=1"),
        ({"vary": {"kk": [1]}}, "no option 'kk'"),
    ],
)
def test_mistakes_are_named(values: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        list(Study(name="own", **values).cells())  # type: ignore[arg-type]
