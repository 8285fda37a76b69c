"""Functions that benchmarks share: they name the machine, time contenders in turns, and write tables."""

from __future__ import annotations

import contextlib
import os
import platform
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path


def describe(*packages: str) -> str:
    """Describes the machine and the versions of some packages, in one line."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        names = [
            line.split(":", 1)[1].strip() for line in cpuinfo.read_text().splitlines() if "model name" in line
        ]
        model = names[0] if names else model
    versions = ", ".join(f"{name} {version(name)}" for name in packages)
    return f"{model}, {os.cpu_count()} cores, one thread used; Python {platform.python_version()}, {versions}"


@contextlib.contextmanager
def one_core(core: int | None = None) -> Iterator[None]:
    """Context manager that keeps all threads of this process on one core, if the system allows it.

    Enter it before libraries make threads, so that they see a single core. XLA is set to use one thread.

    Args:
        core: index of the core; if None, the last core that the process may use.
    """
    os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false")
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    before = os.sched_getaffinity(0)
    _stay_on({max(before) if core is None else core})
    try:
        yield
    finally:
        _stay_on(before)


def _stay_on(cores: set[int]) -> None:
    for thread in os.listdir("/proc/self/task"):  # cores are set for each thread
        with contextlib.suppress(ProcessLookupError):  # the thread has just ended
            os.sched_setaffinity(int(thread), cores)


CLOCKS = {"wall": time.perf_counter, "cpu": time.process_time}


def medians(
    contenders: Mapping[str, Callable[[], int]], *, repeats: int, clock: str = "wall", warm_up: int = 0
) -> dict[str, float]:
    """Measures the seconds for one unit of each contender's work: the median of repeats, taken in turns.

    Args:
        contenders: functions that do some work and return its number of units.
        repeats: number of repeats of each contender.
        clock: ``wall``; or ``cpu``, the processor time of this process, without other work on its core.
        warm_up: number of calls of each contender before it is timed, for instance to compile.
    """
    now = CLOCKS[clock]
    for work in contenders.values():
        for _ in range(warm_up):
            work()
    seconds: dict[str, list[float]] = {name: [] for name in contenders}
    for _ in range(repeats):
        for name, work in contenders.items():
            began = now()
            pieces = work()
            seconds[name].append((now() - began) / pieces)
    return {name: statistics.median(values) for name, values in seconds.items()}


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Formats a Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def publish(text: str, out: Path | None) -> None:
    """Prints a text, and writes it to a file unless ``out`` is None."""
    print(text)
    if out is not None:
        out.write_text(text + "\n")
