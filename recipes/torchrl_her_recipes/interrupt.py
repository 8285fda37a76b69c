"""Ctrl-C that lets the work at hand finish."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


class Interrupted(Exception):
    """Somebody pressed Ctrl-C, and this is a good moment to stop."""


@contextmanager
def soft_interrupt() -> Iterator[Callable[[], None]]:
    """Defers the first Ctrl-C to the next call of what this yields; a second one strikes at once.

    Example:
        >>> with soft_interrupt() as check:
        ...     check()  # raises Interrupted if somebody pressed Ctrl-C
    """
    pressed = threading.Event()

    def check() -> None:
        if pressed.is_set():
            raise Interrupted

    if threading.current_thread() is not threading.main_thread():
        yield check  # signals are the main thread's business
        return

    def handle(_number: int, _frame: FrameType | None) -> None:
        if pressed.is_set():
            raise KeyboardInterrupt
        pressed.set()

    before = signal.signal(signal.SIGINT, handle)
    try:
        yield check
    finally:
        signal.signal(signal.SIGINT, before)
