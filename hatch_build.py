"""Compiles the C++ code into a wheel; ``make wheel`` turns this on, by ``HATCH_BUILD_HOOK_ENABLE_CUSTOM``."""

from __future__ import annotations

import importlib.util
import platform
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

NATIVE = "torchrl_her/native"
SOURCES = (("steps.cpp", "float"), ("steps.cpp", "double"), ("trees.cpp", "float"))
PLATFORMS = (("Linux", "x86_64"), ("Linux", "aarch64"), ("Darwin", "arm64"))
# The C++ library is linked in, as far as it is used. OpenMP's is the one that torch loads.
LINUX = ("-fopenmp", "-static-libstdc++", "-Wl,--gc-sections", "-Wl,--exclude-libs,ALL")
# The oldest system that torch supports there. Apple's compiler has no library for OpenMP.
MACOS = ("-fopenmp-simd", "-mmacosx-version-min=11.0")


def options(system: str, level: str) -> tuple[str, ...]:
    """Returns the compiler's options for a level of processors (see ``library.py``) on Linux or Darwin."""
    wide = ("-mprefer-vector-width=512",) if level.startswith("x86") else ()
    return (f"-march={level}", *wide, *(MACOS if system == "Darwin" else LINUX))


def platform_tag(system: str, machine: str, libraries: Iterable[bytes]) -> str:
    """Returns the oldest platform that can load the libraries: the newest glibc that one of them names."""
    if system == "Darwin":
        return f"macosx_11_0_{machine}"
    minor = max(int(minor) for library in libraries for minor in re.findall(rb"GLIBC_2\.(\d+)", library))
    return f"manylinux_2_{minor}_{machine}"


class CompiledSteps(BuildHookInterface):
    """Compiles each source for each level of this machine's processors."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        system, machine = platform.system(), platform.machine()
        if (system, machine) not in PLATFORMS:
            raise RuntimeError(f"no compiled code for {system} on {machine}: `pip install .` needs none")
        folder = Path(self.root, NATIVE)
        # Importing the package would need torch, which is not there while a wheel is built.
        spec = importlib.util.spec_from_file_location("library", folder / "library.py")
        spec.loader.exec_module(library := importlib.util.module_from_spec(spec))
        libraries = []
        for level in library.LEVELS[machine]:
            made = Path(self.root, "build", level)
            made.mkdir(parents=True, exist_ok=True)
            for source, real in SOURCES:
                path = made / library.shipped_name(source, real)
                library.compile_library(
                    library.find_compiler(), folder / source, path, real=real, extras=options(system, level)
                )
                build_data["force_include"][str(path)] = f"{NATIVE}/{level}/{path.name}"
                libraries.append(path.read_bytes())
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-{platform_tag(system, machine, libraries)}"
