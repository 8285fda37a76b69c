"""Loads the gradient steps in C++."""

from __future__ import annotations

import ctypes
from functools import lru_cache
from typing import Any

import torch

from torchrl_her.native.job import structures
from torchrl_her.native.library import CannotCompile, load_library

_TYPES = {torch.float32: "float", torch.float64: "double"}


@lru_cache
def load_steps(dtype: torch.dtype) -> Any:
    """Returns the C++ function that makes gradient steps in float32 or float64, given the address of a job.

    Args:
        dtype: float32 or float64.

    Raises:
        CannotCompile: see :func:`~torchrl_her.native.load_library`.
    """
    if dtype not in _TYPES:
        raise CannotCompile(f"compiled gradient steps need {', '.join(map(str, _TYPES))}, got {dtype}")
    library = load_library("steps.cpp", headers=("gemm.h", "network.h"), real=_TYPES[dtype])
    assert library.her_job_size() == ctypes.sizeof(structures(dtype).job)
    library.her_steps.restype = None
    library.her_steps.argtypes = [ctypes.c_void_p]
    return library.her_steps
