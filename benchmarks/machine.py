"""What the benchmarks share: naming the machine, timing in turns, writing tables."""

from __future__ import annotations

import os
import platform
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path


def describe(*packages: str) -> str:
    """The machine and the versions of some packages, in a line."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        names = [
            line.split(":", 1)[1].strip() for line in cpuinfo.read_text().splitlines() if "model name" in line
        ]
        model = names[0] if names else model
    versions = ", ".join(f"{name} {version(name)}" for name in packages)
    return f"{model}, {os.cpu_count()} cores, one thread used; Python {platform.python_version()}, {versions}"


def medians(contenders: Mapping[str, Callable[[], int]], *, repeats: int) -> dict[str, float]:
    """Seconds for one piece of work of each contender: the median of repeats taken in turns.

    Args:
        contenders: each does some work and returns how many pieces it was.
        repeats: of each.
    """
    seconds: dict[str, list[float]] = {name: [] for name in contenders}
    for _ in range(repeats):
        for name, work in contenders.items():
            began = time.perf_counter()
            pieces = work()
            seconds[name].append((time.perf_counter() - began) / pieces)
    return {name: statistics.median(values) for name, values in seconds.items()}


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def publish(text: str, out: Path | None) -> None:
    """Prints a text, and writes it to a file if there is to be one."""
    print(text)
    if out is not None:
        out.write_text(text + "\n")
