"""Callbacks: when they are called, what they see, and that a run which they stop can go on."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch

from torchrl_her_recipes import Callback, EarlyStopping, RunView, build, resume, run
from torchrl_her_recipes.runs.folder import RunFolder

from ..small import assert_same_runs, small


class Diary(Callback):
    """Notes when it is called, and may ask for a stop."""

    def __init__(self, *, batches: float = math.inf, epochs: float = math.inf) -> None:
        self.lines: list[str] = []
        self.batches, self.epochs = batches, epochs

    def _note(self, name: str, view: RunView) -> None:
        self.lines.append(f"{name} {view.trainer.epochs} {view.trainer.frames} {len(view.rows)}")

    def on_start(self, run: RunView) -> None:
        self._note("start", run)

    def on_batch(self, run: RunView) -> bool:
        self._note("batch", run)
        return len(self.lines) - 1 >= self.batches

    def on_epoch(self, run: RunView) -> bool:
        self._note("epoch", run)
        return run.trainer.epochs >= self.epochs

    def on_end(self, run: RunView) -> None:
        assert run.folder is None or run.folder.policy.exists()
        self._note("end", run)


SHORT = {"epoch_frames": 160, "num_envs": 8, "steps_per_batch": 10}


def test_callbacks_are_called_in_order_and_see_the_run() -> None:
    diary = Diary()
    result = run(build(small(**SHORT)), callbacks=[diary], progress=False)
    assert diary.lines == [
        *("start 0 0 0", "batch 0 80 0", "batch 0 160 0", "epoch 1 160 1"),
        *("batch 1 240 1", "batch 1 320 1", "epoch 2 320 2", "end 2 320 2"),
    ]
    assert not result.stopped


class Column(Callback):
    """Adds a column to the table."""

    def __init__(self, value: Any) -> None:
        self.value = value

    def on_epoch(self, run: RunView) -> None:
        run.rows[-1]["mine"] = self.value


@pytest.mark.parametrize("value", [3.5, torch.tensor(3.5), np.float32(3.5)])
def test_columns_of_callbacks_may_be_numbers_of_any_kind(value: Any, tmp_path: Path) -> None:
    run(build(small(**SHORT)), tmp_path, callbacks=[Column(value)], progress=False)
    assert [row["mine"] for row in RunFolder(tmp_path).rows()] == [3.5, 3.5]


def test_other_columns_are_refused_before_they_spoil_the_table(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="^column 'mine' of the table must hold numbers, got 'good'$"):
        run(build(small(**SHORT)), tmp_path, callbacks=[Column("good")], progress=False)
    assert len(resume(tmp_path, progress=False).rows) == 2


def test_all_callbacks_are_called_although_the_first_one_stops_the_run() -> None:
    first, second = Diary(batches=1), Diary()
    result = run(build(small(**SHORT)), callbacks=[first, second], progress=False)
    assert second.lines == ["start 0 0 0", "batch 0 80 0", "end 0 80 0"]
    assert result.stopped
    assert not result.interrupted


@pytest.mark.parametrize("when", [{"batches": 3}, {"batches": 4}, {"epochs": 1}, {"epochs": 2}])
def test_a_run_that_is_stopped_goes_on_bit_for_bit(when: dict[str, int], tmp_path: Path) -> None:
    recipe = small(epochs=3, checkpoint_interval=2, seed=3)
    run(build(recipe), tmp_path / "whole", progress=False)
    diary = Diary(**when)
    assert run(build(recipe), tmp_path / "part", callbacks=[diary], progress=False).stopped
    assert (tmp_path / "part" / "policy.safetensors").exists()
    assert not RunFolder(tmp_path / "part").is_done
    again = Diary()
    assert not resume(tmp_path / "part", callbacks=[again], progress=False).stopped
    assert again.lines[0] == diary.lines[-1].replace("end", "start")
    assert_same_runs(tmp_path / "whole", tmp_path / "part")


def test_a_stop_at_the_last_epoch_is_none() -> None:
    result = run(build(small(**SHORT)), callbacks=[Diary(epochs=2)], progress=False)
    assert not result.stopped


def test_a_number_that_a_callback_adds_is_in_the_table(tmp_path: Path) -> None:
    class Halves(Callback):
        def on_epoch(self, run: RunView) -> None:
            run.rows[-1]["half"] = run.rows[-1]["frames"] / 2

    run(build(small(**SHORT)), tmp_path, callbacks=[Halves()], progress=False)
    assert pd.read_csv(tmp_path / "metrics.csv")["half"].tolist() == [80, 160]


def test_what_a_callback_raises_ends_the_run() -> None:
    class Broken(Callback):
        def on_batch(self, run: RunView) -> bool:
            raise RuntimeError("no")

    diary = Diary()
    with pytest.raises(RuntimeError, match="^no$"):
        run(build(small(**SHORT)), callbacks=[Broken(), diary], progress=False)
    assert diary.lines == ["start 0 0 0"]


# Early stopping


def table(*values: tuple[float, ...], metric: str = "success") -> list[dict[str, float]]:
    """Rows of epochs, with the values of the runs of each."""
    return [
        {"run": index, "epoch": epoch, "updates": 10 * epoch, metric: value}
        for epoch, own in enumerate(values, start=1)
        for index, value in enumerate(own)
    ]


@pytest.mark.parametrize(
    ("values", "reached"),
    [
        ([(0.9, 0.9, 0.9)], False),  # one evaluation
        ([(0.9, 0.0, 0.9), (1.0, 1.0, 0.1)], True),  # the median counts
        ([(0.9, 0.0, 0.8), (1.0, 1.0, 0.1)], False),
        ([(1.0, 1.0, 1.0), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)], False),  # not in a row
        ([(0.0, 0.0, 0.0), (0.9, 0.9, 0.9), (0.9, 0.9, 0.9)], True),
        ([(0.9, 0.9, 0.9), (math.nan, math.nan, 1.0)], False),
        ([(0.9, 0.9, 0.9), (math.nan, 0.9, 1.0)], True),
    ],
)
def test_the_median_must_be_good_enough_in_a_row(values: list[tuple[float, ...]], reached: bool) -> None:
    assert EarlyStopping(at_least=0.9, epochs=2).reached(table(*values)) is reached


def test_small_values_may_be_the_good_ones() -> None:
    stopping = EarlyStopping("distance", at_most=0.1)
    assert stopping.reached(table((0.5,), (0.1,), metric="distance"))
    assert not stopping.reached(table((0.1,), (0.2,), metric="distance"))
    assert not stopping.reached(table((math.nan,), metric="distance"))


def test_a_metric_that_begins_with_the_updates_is_waited_for() -> None:
    stopping = EarlyStopping("loss_value", at_most=1.0)
    assert not stopping.reached([{"run": 0, "epoch": 1, "updates": 0, "success": 0.0}])
    assert stopping.reached(table((0.5,), metric="loss_value"))


def test_what_cannot_stop_a_run_is_named() -> None:
    with pytest.raises(ValueError, match="give at_least or at_most, got at_least=None and at_most=None"):
        EarlyStopping()
    with pytest.raises(ValueError, match="got at_least=0.5 and at_most=0.6"):
        EarlyStopping(at_least=0.5, at_most=0.6)
    with pytest.raises(ValueError, match="epochs must be at least 1, got 0"):
        EarlyStopping(at_least=0.5, epochs=0)
    with pytest.raises(ValueError, match="metric must be one of run, epoch, updates, success, got 'sucess'"):
        EarlyStopping("sucess", at_least=0.5).reached(table((1.0,)))
