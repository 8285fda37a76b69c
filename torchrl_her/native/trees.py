"""Loads the C++ functions that draw from trees of sums and update them."""

from __future__ import annotations

import ctypes
from functools import lru_cache
from typing import Any

from torchrl_her.native.library import CannotCompile, load_library

_ARGUMENTS = {  # types of each function's arguments after levels, widths, number of levels and runs
    "her_trees_draw": [ctypes.c_int64, *[ctypes.c_void_p] * 3],
    "her_trees_set": [ctypes.c_int64, *[ctypes.c_void_p] * 2],
}


@lru_cache
def load_trees() -> Any:
    """Loads the library of ``trees.cpp``, compiled once for this processor; None if that fails."""
    try:
        library = load_library("trees.cpp")
    except CannotCompile:
        return None
    for name, arguments in _ARGUMENTS.items():
        function = getattr(library, name)
        function.restype = None
        function.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int, ctypes.c_int64, *arguments]
    return library
