"""Compiles C++ once for this machine and loads it, or loads the compiled library of a wheel.

The build of a wheel (``hatch_build.py``) runs this file without torch, so it must not import torch.
"""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import importlib.util
import logging
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Collection, Sequence
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
# Compiler options, tried in this order: some compilers lack some of them, or (zig) OpenMP's library.
_EXTRAS = (
    ("-march=native", "-mprefer-vector-width=512", "-fopenmp"),
    ("-march=native", "-mprefer-vector-width=512", "-fopenmp-simd"),
    ("-march=native", "-fopenmp"),
    ("-mcpu=native", "-fopenmp"),
    ("-march=native",),
    ("-mcpu=native",),
    (),
)
_V3 = frozenset(("abm", "avx2", "bmi1", "bmi2", "f16c", "fma", "movbe"))
_ARM: dict[str, frozenset[str]] = {"armv8-a": frozenset()}  # every ARM processor of 64 bits has this level
# Instruction sets (levels) for which wheels have libraries: the fastest first, with the flags of
# each in /proc/cpuinfo.
LEVELS = {
    "x86_64": {
        "x86-64-v4": _V3 | {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"},
        "x86-64-v3": _V3,
    },
    "aarch64": _ARM,
    "arm64": _ARM,  # aarch64 is called arm64 on macOS
}
_SHIPPED = Path(__file__).parent  # in a wheel, this folder has a subfolder for each level
_LOGGER = logging.getLogger("torchrl_her")


class CannotCompile(RuntimeError):
    """There is no C++ compiler, or it failed."""


def load_library(source: str, *, headers: Sequence[str] = (), real: str = "float") -> ctypes.CDLL:
    """Returns the library of a C++ source of this package.

    It is compiled for this processor the first time, which takes some seconds, and kept in the user's cache:
    the folder that ``TORCHRL_HER_CACHE`` names, or ``torchrl_her`` in ``XDG_CACHE_HOME``. The
    compiler is ``CXX`` from the environment, or else g++, clang++ or c++. Without a compiler, the library
    in the wheel is loaded; if the wheel has none for this processor, the package ``ziglang`` compiles.

    Args:
        source: the file's name.
        headers: the files that it includes.
        real: type that ``REAL`` stands for in the source.

    Raises:
        CannotCompile: none of the three ways works; the message says why the compiler failed.
    """
    errors: list[Exception] = []
    for load in (
        lambda: _load_compiled(find_compiler(), source, headers, real),
        lambda: _load_shipped(source, real),
        lambda: _load_compiled(find_ziglang(), source, headers, real),
    ):
        try:
            return load()
        # Possible causes: a compiler that cannot run, no home, a full disk, a folder without write access.
        except (OSError, RuntimeError) as error:
            errors.append(error)
    if isinstance(errors[0], CannotCompile):
        raise errors[0]
    raise CannotCompile(f"{source} cannot be compiled or loaded: {errors[0]}") from errors[0]


def compile_library(
    compiler: Sequence[str], source: Path, library: Path, *, real: str, extras: Sequence[str]
) -> None:
    """Compiles a C++ source with one set of further options.

    Raises:
        CannotCompile: the compiler failed; the message has the first line that it wrote.
    """
    command = [*compiler, *_FLAGS, *extras, f"-DREAL={real}", str(source), "-o", str(library)]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    if result.returncode:
        error = result.stderr.strip().partition("\n")[0] or "?"
        raise CannotCompile(f"{' '.join(compiler)} cannot compile {source.name}: {error}")


def shipped_name(source: str, real: str) -> str:
    """Returns the name of a compiled library in a wheel, which has a folder for each set of instructions.

    Example:
        >>> shipped_name("steps.cpp", "float")
        'steps-float.so'
    """
    return f"{Path(source).stem}-{real}.so"


def levels(machine: str, flags: Collection[str]) -> list[str]:
    """Returns the levels (sets of instructions) whose libraries a processor can run, the fastest first.

    Args:
        machine: kind of processor, as ``platform.machine()`` names it.
        flags: names of its instruction sets, as in ``/proc/cpuinfo``.

    Example:
        >>> levels("x86_64", "fma avx2 bmi1 bmi2 f16c movbe abm avx512f".split())
        ['x86-64-v3']
        >>> levels("arm64", [])
        ['armv8-a']
    """
    return [level for level, needed in LEVELS.get(machine, {}).items() if needed.issubset(flags)]


def _load_shipped(source: str, real: str) -> ctypes.CDLL:
    for level in levels(platform.machine(), _processor_flags().split()):
        with contextlib.suppress(OSError):  # not installed from a wheel, or system libraries are too old
            return ctypes.CDLL(str(_SHIPPED / level / shipped_name(source, real)))
    raise CannotCompile(f"no wheel has a library of {source} for this processor")


def _load_compiled(compiler: Sequence[str], source: str, headers: Sequence[str], real: str) -> ctypes.CDLL:
    folder = Path(__file__).parent
    text = "".join((folder / name).read_text(encoding="utf-8") for name in (source, *headers))
    # The processor is part of the file's name: machines with other instruction sets may share a cache.
    processor = (platform.machine(), platform.processor(), _processor_flags())
    made_of = (text, real, *compiler, _version(compiler), str(_FLAGS), str(_EXTRAS), *processor)
    name = hashlib.sha256("\n".join(made_of).encode()).hexdigest()[:20]
    library = _cache() / f"{Path(source).stem}-{real}-{name}.so"
    with contextlib.suppress(OSError):  # the library is missing or damaged
        return ctypes.CDLL(str(library))
    _LOGGER.info("compiling %s (%s), once for this machine", source, real)
    return _compile(compiler, folder / source, real, library)


def _compile(compiler: Sequence[str], source: Path, real: str, library: Path) -> ctypes.CDLL:
    """Tries the sets of options in order; returns the first library that compiles and loads."""
    library.parent.mkdir(parents=True, exist_ok=True)
    errors: list[Exception] = []
    with tempfile.TemporaryDirectory(dir=library.parent) as folder:
        compiled = Path(folder) / library.name
        for extras in _EXTRAS:
            try:
                compile_library(compiler, source, compiled, real=real, extras=extras)
                loaded = ctypes.CDLL(str(compiled))
            except (CannotCompile, OSError) as error:
                errors.append(error)
            else:
                os.replace(compiled, library)  # atomic: other processes may compile it, too
                return loaded
    raise errors[0]


def find_compiler() -> list[str]:
    """Returns the compiler with its own options, since ``CXX`` may be ``ccache g++``.

    Raises:
        CannotCompile: there is none.
    """
    command = os.environ.get("CXX", "").split()
    for name, *options in [command] if command else [["g++"], ["clang++"], ["c++"]]:
        if path := shutil.which(name):
            return [path, *options]
    named = f" {command[0]}" if command else " (g++ or clang++; `pip install ziglang` brings one)"
    raise CannotCompile(f"there is no C++ compiler{named}")


def find_ziglang() -> list[str]:
    """Returns the command of the compiler in the package ``ziglang``, whose first run takes a minute.

    Raises:
        CannotCompile: it is not installed, or ``CXX`` asks for another one.
    """
    if os.environ.get("CXX") or not importlib.util.find_spec("ziglang"):
        raise CannotCompile("the package ziglang is not installed, or CXX asks for another compiler")
    return [sys.executable, "-m", "ziglang", "c++"]


def _version(compiler: Sequence[str]) -> str:
    return subprocess.run([*compiler, "--version"], capture_output=True, text=True, check=False).stdout


def _processor_flags() -> str:
    """Names of the processor's instruction sets, as Linux lists them; nothing on other systems."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.exists() else []
    return next((line for line in lines if line.startswith(("flags", "Features"))), "")


def _cache() -> Path:
    if path := os.environ.get("TORCHRL_HER_CACHE"):
        return Path(path)
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "torchrl_her"
