"""Ctrl-C: the first lets the work at hand finish, a later one strikes."""

from __future__ import annotations

import os
import signal
import threading

import pytest

from torchrl_her_recipes.runs import interrupt
from torchrl_her_recipes.runs.interrupt import Interrupted, soft_interrupt


def press(number: int = signal.SIGINT) -> None:
    os.kill(os.getpid(), number)


def test_the_first_one_waits_for_a_good_moment() -> None:
    with soft_interrupt() as check:
        check()
        press()
        with pytest.raises(Interrupted):
            check()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_being_asked_to_end_is_as_good_as_ctrl_c(number: int) -> None:
    before = signal.signal(number, signal.SIG_DFL)  # it may be ignored here
    try:
        with soft_interrupt() as check:
            press(number)
            with pytest.raises(Interrupted):
                check()
        assert signal.getsignal(number) is signal.SIG_DFL
    finally:
        signal.signal(number, before)


def test_what_is_ignored_stays_ignored() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with soft_interrupt() as check:
            press(signal.SIGHUP)
            check()
    finally:
        signal.signal(signal.SIGHUP, before)


def test_signals_that_come_together_count_as_one() -> None:
    with soft_interrupt() as check:
        press()
        press()
        with pytest.raises(Interrupted):
            check()


def test_a_later_one_strikes_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(interrupt, "_TOGETHER", -1.0)
    with pytest.raises(KeyboardInterrupt), soft_interrupt():
        press()


def test_the_handler_from_before_comes_back() -> None:
    before = signal.getsignal(signal.SIGINT)
    with soft_interrupt():
        assert signal.getsignal(signal.SIGINT) is not before
    assert signal.getsignal(signal.SIGINT) is before


def test_other_threads_leave_signals_alone() -> None:
    def work() -> None:
        with soft_interrupt() as check:
            check()
            checked.append(True)

    checked: list[bool] = []
    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert checked == [True]
