"""Compiling a pure function of tensors, with a way out where no compiler is there."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from types import FunctionType
from typing import Any

import torch

# One program in C++ without Python between its kernels, for one thread: what small networks need.
_OPTIONS: dict[str, Any] = {"cpp_wrapper": True, "cpp.threads": 1}


class CompiledOnce:
    """A function of tensors, compiled at its first call for the shapes and types of that call.

    Where compiling fails, for instance because there is no C++ compiler, it warns once and stays
    the function that it was. TorchInductor keeps what it compiled on disk: the next process only
    loads it.

    Args:
        function: takes and returns (nested) tuples and lists of tensors; may change them in place, but
            none may come in twice. It is always called with the same numbers, and with tensors of the
            same shapes, strides, types and devices and without gradients: nothing checks that.

    Attributes:
        compiled: whether calls are served by the compiled form.
        seconds: that compiling took, or loading what an earlier process compiled.

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
            result = self._function(*args)  # raises, too, if it is the arguments
            self._call = self._function
            reason = str(error).strip().split("\n")[0]
            warnings.warn(f"{self._function.__name__} is not compiled: {reason}", stacklevel=3)
            return result
        self._call, self.compiled, self.seconds = candidate, True, time.perf_counter() - began
        return result


def _own_code(function: Callable[..., Any]) -> Callable[..., Any]:
    """The same function with a code object of its own, by which torch.compile keeps what it compiled."""
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
    """Checking seventy tensors at each call takes a fifth of the time of a small step."""
    return [False] * len(guards)
