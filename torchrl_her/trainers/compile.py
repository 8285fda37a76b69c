"""Compiling a function of tensors, which works uncompiled where there is no compiler."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from types import FunctionType
from typing import Any

import torch

# One C++ program for one thread, without Python between its kernels: the fastest for small networks.
_OPTIONS: dict[str, Any] = {"cpp_wrapper": True, "cpp.threads": 1}


class CompiledOnce:
    """A function of tensors that is compiled at its first call, for the shapes and types of that call.

    If compiling fails, for instance because there is no C++ compiler, it warns once and calls the function as
    it is. TorchInductor stores what it compiled on disk, so the next process only loads it.

    Args:
        function: takes and returns (nested) tuples and lists of tensors. It may change them in place, but no
            tensor may be passed twice. Every call must pass the same numbers, and tensors with the same
            shapes, strides, types and devices that need no gradients: nothing checks that.

    Attributes:
        compiled: whether calls use the compiled form.
        seconds: time that compiling took, or loading what an earlier process compiled.

    Example:
        >>> def double(x):
        ...     return 2 * x
        >>> CompiledOnce(double)  # compiles when it is called
        CompiledOnce(double)
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function
        self._call: Callable[..., Any] | None = None
        self.compiled = False
        self.seconds = 0.0

    def __call__(self, *args: Any) -> Any:
        if self._call is None:
            return self._first(*args)
        return self._call(*args)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self._function.__name__})"

    def _first(self, *args: Any) -> Any:
        candidate = torch.compile(
            _own_code(self._function),
            fullgraph=True,
            dynamic=False,
            options=_OPTIONS | {"guard_filter_fn": _no_guards},
        )
        began = time.perf_counter()
        try:
            result = candidate(*args)
        except Exception as error:  # there are many types, some of them private
            result = self._function(*args)  # raises as well if the arguments are to blame
            self._call = self._function
            reason = str(error).strip().split("\n")[0]
            warnings.warn(f"{self._function.__name__} is not compiled: {reason}", stacklevel=3)
            return result
        self._call, self.compiled, self.seconds = candidate, True, time.perf_counter() - began
        return result


def _own_code(function: Callable[..., Any]) -> Callable[..., Any]:
    """A copy of a function with its own code object: torch.compile caches by code object."""
    assert isinstance(function, FunctionType)
    copy = FunctionType(
        function.__code__.replace(),
        function.__globals__,
        function.__name__,
        function.__defaults__,
        function.__closure__,
    )
    copy.__kwdefaults__ = function.__kwdefaults__
    return copy


def _no_guards(guards: list[Any]) -> list[bool]:
    """Drops all guards: checking seventy tensors at each call would take a fifth of a small step's time."""
    return [False] * len(guards)
