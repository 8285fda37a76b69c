"""What tests of reports share: few repetitions of the bootstrap, and an unfinished study with its report."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from pathlib import Path

import pytest

from torchrl_her_recipes.cli import main
from torchrl_her_recipes.reports import compare

from .small_study import STUDY, write_run, write_study


@pytest.fixture(autouse=True, scope="package")
def _few_repetitions() -> Iterator[None]:
    """Intervals take seconds, and are tested with the bootstrap."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compare, "bootstrap", functools.partial(compare.bootstrap, repetitions=10))
        yield


@pytest.fixture(scope="package")
def unfinished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a study, a quarter of which is missing and another not at its end; and its report."""
    folder = tmp_path_factory.mktemp("runs")
    write_run(folder, STUDY, "hand_v2_her", [0.0, 0.1, 0.3, 0.9])
    write_run(folder, STUDY, "hand_v2_filtered_her", [0.5, 0.7, 0.9, 1.0])
    write_run(folder, STUDY, "robot_v2_her", [0.25, 0.25, 0.25, 0.25], epochs=2)
    assert main(["report", str(write_study(folder)), "--folder", str(folder)]) == 0
    return folder
