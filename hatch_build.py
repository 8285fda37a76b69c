"""Compiles the C++ code into a wheel; ``make wheel`` turns this on, by ``HATCH_BUILD_HOOK_ENABLE_CUSTOM``."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

NATIVE = "torchrl_her/native"
SOURCES = (("steps.cpp", "float"), ("steps.cpp", "double"), ("trees.cpp", "float"))
# The C++ library is linked in, as far as it is used. OpenMP's is the one that torch loads.
LINKED = ("-static-libstdc++", "-Wl,--gc-sections", "-Wl,--exclude-libs,ALL")


class CompiledSteps(BuildHookInterface):
    """Compiles each source for each level of x86-64 with the g++ of this machine, which must be Linux."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        folder = Path(self.root, NATIVE)
        # Importing the package would need torch, which is not there while a wheel is built.
        spec = importlib.util.spec_from_file_location("library", folder / "library.py")
        spec.loader.exec_module(library := importlib.util.module_from_spec(spec))
        for level in library.LEVELS:
            made = Path(self.root, "build", level)
            made.mkdir(parents=True, exist_ok=True)
            extras = (f"-march={level}", "-mprefer-vector-width=512", "-fopenmp", *LINKED)
            for source, real in SOURCES:
                path = made / library.shipped_name(source, real)
                library.compile_library(
                    library.find_compiler(), folder / source, path, real=real, extras=extras
                )
                build_data["force_include"][str(path)] = f"{NATIVE}/{level}/{path.name}"
        build_data["pure_python"] = False
        build_data["tag"] = "py3-none-linux_x86_64"
