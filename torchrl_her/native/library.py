"""Compiling C++ for this machine, once, and loading it."""

from __future__ import annotations

import ctypes
import hashlib
import logging
import os
import platform
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

_FLAGS = (
    "-std=c++17",
    "-O3",
    "-ffp-contract=fast",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-shared",
    "-fPIC",
)
# Tried in this order, since not every compiler knows them.
_EXTRAS = (
    ("-march=native", "-mprefer-vector-width=512", "-fopenmp"),
    ("-march=native", "-fopenmp"),
    ("-mcpu=native", "-fopenmp"),
    ("-march=native",),
    ("-mcpu=native",),
    (),
)
_LOGGER = logging.getLogger("torchrl_her")


class CannotCompile(RuntimeError):
    """There is no C++ compiler, or it failed."""


def load_library(source: str, *, headers: Sequence[str] = (), real: str = "float") -> ctypes.CDLL:
    """The library of a C++ source of this package.

    It is compiled for this processor the first time, which takes some seconds, and kept in the user's cache:
    the folder that ``TORCHRL_HER_CACHE`` names, or ``torchrl_her`` in that of ``XDG_CACHE_HOME``. The
    compiler is ``CXX`` from the environment, or else g++, clang++ or c++.

    Args:
        source: the file's name.
        headers: the files that it includes.
        real: what ``REAL`` stands for in it.

    Raises:
        CannotCompile: there is no compiler, or it failed, or the library cannot be loaded; the message says
            which.
    """
    try:
        compiler, folder = _compiler(), Path(__file__).parent
        text = "".join((folder / name).read_text(encoding="utf-8") for name in (source, *headers))
        made_of = (text, real, *compiler, _version(compiler), str(_FLAGS), str(_EXTRAS), _processor())
        name = hashlib.sha256("\n".join(made_of).encode()).hexdigest()[:20]
        library = _cache() / f"{Path(source).stem}-{real}-{name}.so"
        if not library.exists():
            _LOGGER.info("compiling %s (%s), once for this machine", source, real)
            _compile(compiler, folder / source, real, library)
        return ctypes.CDLL(str(library))
    # A compiler that cannot run, no home, a full disk, a folder that must not be written, a damaged file.
    except (OSError, RuntimeError) as error:
        if isinstance(error, CannotCompile):
            raise
        raise CannotCompile(f"{source} cannot be compiled or loaded: {error}") from error


def _compile(compiler: Sequence[str], source: Path, real: str, library: Path) -> None:
    library.parent.mkdir(parents=True, exist_ok=True)
    error = ""
    with tempfile.TemporaryDirectory(dir=library.parent) as folder:
        made = Path(folder) / library.name
        for extras in _EXTRAS:
            command = [*compiler, *_FLAGS, *extras, f"-DREAL={real}", str(source), "-o", str(made)]
            result = subprocess.run(command, capture_output=True, text=True, check=False)
            if result.returncode == 0:
                os.replace(made, library)  # at once: other processes may be compiling the same
                return
            error = error or result.stderr.strip()
    raise CannotCompile(
        f"{compiler[0]} cannot compile {source.name}: {error.splitlines()[0] if error else '?'}"
    )


def _compiler() -> list[str]:
    """The compiler and options of its own: ``CXX`` may say ``ccache g++``."""
    wanted = os.environ.get("CXX", "").split()
    for name, *options in [wanted] if wanted else [["g++"], ["clang++"], ["c++"]]:
        if path := shutil.which(name):
            return [path, *options]
    named = f" {wanted[0]}" if wanted else " (g++ or clang++)"
    raise CannotCompile(f"there is no C++ compiler{named}")


def _version(compiler: Sequence[str]) -> str:
    return subprocess.run([*compiler, "--version"], capture_output=True, text=True, check=False).stdout


def _processor() -> str:
    """Describes the processor: a cache may be shared by machines that need other instructions."""
    flags = ""
    info = Path("/proc/cpuinfo")
    if info.exists():
        lines = info.read_text(encoding="utf-8").splitlines()
        flags = next((line for line in lines if line.startswith(("flags", "Features"))), "")
    return "\n".join((platform.machine(), platform.processor(), flags))


def _cache() -> Path:
    if own := os.environ.get("TORCHRL_HER_CACHE"):
        return Path(own)
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "torchrl_her"
