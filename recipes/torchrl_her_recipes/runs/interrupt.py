"""Handles Ctrl-C and similar signals, so that a run can save its state before it ends."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

_TOGETHER = 1.0  # seconds within which several signals count as one
_OTHERS = ("SIGTERM", "SIGHUP")  # from `kill`, job schedulers, closed terminals; missing on some systems


class Interrupted(Exception):
    """Raised after Ctrl-C or a similar signal, at a moment when the run can be saved."""


@contextmanager
def soft_interrupt() -> Iterator[Callable[[], None]]:
    """Defers the first Ctrl-C until the yielded function is called; a second Ctrl-C takes effect at once.

    SIGTERM and SIGHUP count as Ctrl-C, unless they are ignored, as under ``nohup``. Signals within a second
    count as one, since a process may get the same request twice: from its parent and from its process group.

    Example:
        >>> with soft_interrupt() as check:
        ...     check()  # raises Interrupted after Ctrl-C
    """
    pressed: list[float] = []  # times at which signals arrived

    def check() -> None:
        if pressed:
            raise Interrupted

    if threading.current_thread() is not threading.main_thread():
        yield check  # only the main thread can handle signals
        return

    def handle(_number: int, _frame: FrameType | None) -> None:
        pressed.append(time.monotonic())
        if pressed[-1] - pressed[0] > _TOGETHER:
            raise KeyboardInterrupt

    others = [getattr(signal, name) for name in _OTHERS if hasattr(signal, name)]
    heard = [number for number in others if signal.getsignal(number) is not signal.SIG_IGN]
    before = {number: signal.signal(number, handle) for number in (signal.SIGINT, *heard)}
    try:
        yield check
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
