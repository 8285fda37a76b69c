"""Doing the jobs of a plan: what fails holds nothing back, and Ctrl-C is passed on."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path
from threading import Event

import pytest

from torchrl_her_recipes.runs import interrupt
from torchrl_her_recipes.studies import schedule as scheduling
from torchrl_her_recipes.studies.jobs import Job, Outcome, Progress
from torchrl_her_recipes.studies.plan import Plan
from torchrl_her_recipes.studies.schedule import run_jobs

from ..small import small


class Actors:
    """Play workers: each job has the outcome that it is given; without one it lasts until it is told to stop.

    Args:
        presses: how often somebody presses Ctrl-C meanwhile.
        obedient: whether they stop when they are told to.
        outcomes: by label.
    """

    at_once = 2

    def __init__(
        self, *, presses: int = 0, obedient: bool = True, **outcomes: Outcome | OSError | None
    ) -> None:
        self.presses, self.obedient, self.outcomes = presses, obedient, outcomes
        self.ended = Event()
        self.closed = False

    def run(self, job: Job) -> Outcome:
        outcome = self.outcomes[job.label]
        if isinstance(outcome, OSError):
            raise outcome
        if outcome is not None:
            return outcome
        assert self.ended.wait(10)
        return Outcome(interrupted=True)

    def progress(self) -> dict[str, Progress]:
        if self.presses:
            self.presses -= 1
            os.kill(os.getpid(), signal.SIGINT)
        return {label: Progress(1, 1.0) for label, outcome in self.outcomes.items() if outcome is None}

    def stop(self) -> None:
        if self.obedient:
            self.ended.set()

    def close(self) -> None:
        self.closed = True
        self.ended.set()


def plan(folder: Path, *labels: str) -> Plan:
    return Plan(Job(label=label, recipe=small(), folder=folder / label) for label in labels)


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scheduling, "_TICK", 0.01)


def test_one_that_fails_holds_no_other_back(tmp_path: Path) -> None:
    workers = Actors(a=Outcome(error="why"), b=Outcome(), c=OSError("disk\nfull"))
    assert run_jobs(plan(tmp_path, "a", "b", "c"), workers, progress=False) == {
        "a": Outcome(error="why"),
        "b": Outcome(),
        "c": Outcome(error="OSError('disk\\nfull')"),
    }
    assert workers.closed


def test_ctrl_c_is_passed_on_and_all_are_waited_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    workers = Actors(presses=1, a=None, b=Outcome(), c=None)
    work = plan(tmp_path, "a", "b", "c")
    outcomes = run_jobs(work, workers)
    assert outcomes == {"a": Outcome(interrupted=True), "b": Outcome(), "c": Outcome(interrupted=True)}
    assert workers.closed
    shown = capsys.readouterr().err
    assert "960/2.88k steps" in shown  # an epoch of a and of c
    assert "2 running, 0 waiting, about" in shown
    assert "saving what there is" in shown


def test_where_there_is_no_terminal_a_few_lines_are_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    workers = Actors(presses=1, a=None, b=Outcome(error="why"), c=Outcome(), d=None)
    run_jobs(plan(tmp_path, "a", "b", "c", "d"), workers)
    said, lines = capsys.readouterr()
    assert said == ""
    *ended, share, stopping, one, other = lines.splitlines()
    assert sorted(ended) == ["b: failed", "c: done"]
    assert share.startswith("25% of all steps: 2 running, 0 waiting, about ")
    assert stopping == "saving what there is"
    assert sorted([one, other]) == ["a: interrupted", "d: interrupted"]


def test_a_second_one_ends_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(interrupt, "_TOGETHER", 0.0)
    workers = Actors(presses=2, obedient=False, a=None)
    with pytest.raises(KeyboardInterrupt):
        run_jobs(plan(tmp_path, "a"), workers, progress=False)
    assert workers.closed


def test_nothing_to_do(tmp_path: Path) -> None:
    workers = Actors()
    assert run_jobs(plan(tmp_path), workers, progress=False) == {}
    assert workers.closed
