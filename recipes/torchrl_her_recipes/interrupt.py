"""Ctrl-C that lets the work at hand finish."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

_TOGETHER = 1.0  # seconds


class Interrupted(Exception):
    """Somebody pressed Ctrl-C, and this is a good moment to stop."""


@contextmanager
def soft_interrupt() -> Iterator[Callable[[], None]]:
    """Defers the first Ctrl-C to the next call of what this yields; a later one strikes at once.

    Signals that come together, as from a process group and its parent, count as one.

    Example:
        >>> with soft_interrupt() as check:
        ...     check()  # raises Interrupted if somebody pressed Ctrl-C
    """
    pressed: list[float] = []  # when

    def check() -> None:
        if pressed:
            raise Interrupted

    if threading.current_thread() is not threading.main_thread():
        yield check  # signals are the main thread's business
        return

    def handle(_number: int, _frame: FrameType | None) -> None:
        pressed.append(time.monotonic())
        if pressed[-1] - pressed[0] > _TOGETHER:
            raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, handle)
    try:
        yield check
    finally:
        signal.signal(signal.SIGINT, before)
