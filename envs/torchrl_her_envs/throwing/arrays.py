"""Functions and constants by which the same code works on numbers, NumPy arrays and tensors."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

Array = TypeVar("Array", np.ndarray, Tensor)

_OF_NUMBERS = SimpleNamespace(cos=math.cos, sin=math.sin, __name__="numbers")


def functions_of(values: Any) -> Any:
    """Returns the module of functions for values: ``numpy``, ``torch``, or some of ``math``'s for a number.

    Use only functions that all three have under one name, with positional arguments.

    Example:
        >>> [functions_of(value).__name__ for value in (np.zeros(2), torch.zeros(2), 0.5)]
        ['numpy', 'torch', 'numbers']
    """
    if isinstance(values, float):
        return _OF_NUMBERS
    return np if isinstance(values, np.ndarray) else torch


def like(constant: np.ndarray, values: Array) -> Array:
    """Converts a constant to the form of ``values``: an array, or a tensor of the same dtype and device.

    Example:
        >>> like(np.array([0.5]), torch.zeros(2)).dtype
        torch.float32
    """
    return constant if isinstance(values, np.ndarray) else torch.as_tensor(constant).to(values)


def confined(value: Any, low: Any, high: Any) -> Any:
    """Clamps a number, or each one of an array, to bounds.

    Example:
        >>> confined(3.5, -1.0, 1.0)
        1.0
    """
    if isinstance(value, float):
        return low if value < low else high if value > high else value
    xp = functions_of(value)
    return xp.minimum(xp.maximum(value, low), high)


def within(dx: Any, dy: Any, distance: float) -> Any:
    """Returns whether offsets are shorter than a distance: a bool for numbers, [...] of bool for arrays.

    Example:
        >>> within(0.3, 0.4, 0.5), within(0.3, 0.4, 0.51)
        (False, True)
    """
    # Adds the two coordinates itself: summing over a dimension of two takes several times as long.
    return dx * dx + dy * dy < distance**2
