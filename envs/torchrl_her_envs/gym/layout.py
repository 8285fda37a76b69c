"""Converts observations, goals and actions, nested dictionaries included, to rows of numbers and back."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces

_LARGEST = np.finfo(np.float32).max  # as a number of Python's, it would be infinite beside float16


@dataclass(frozen=True)
class _Leaf:
    """An array in a nested dictionary: the keys that lead to it, its shape and type."""

    path: tuple[str, ...]
    shape: tuple[int, ...]
    dtype: np.dtype

    @property
    def width(self) -> int:
        return math.prod(self.shape)


class Layout:
    """The order in which the entries of a space follow each other in a vector of ``width`` numbers.

    A vector stays as it is, and a matrix is written row by row. The entries of a dictionary follow each
    other in the alphabetical order of their keys, and so do those of a nested dictionary at its place. The
    order of keys in a space or an observation makes no difference, so that achieved and desired goals always
    agree.

    Args:
        space: space of an array, a whole number, or a dictionary of these and further dictionaries.
        name: name of the space, for messages.

    Raises:
        ValueError: something in it is not an array of numbers.

    Example:
        >>> arm, ball = spaces.Box(-1, 1, (2,)), spaces.Dict(y=spaces.Box(0, 9), x=spaces.Box(0, 9))
        >>> layout = Layout(spaces.Dict(ball=ball, arm=arm), "a goal")
        >>> row = layout.flatten({"ball": {"y": [3.0], "x": [2.0]}, "arm": [0.5, 1.0]})
        >>> row.tolist(), layout.entries
        ([0.5, 1.0, 2.0, 3.0], ['arm', 'ball.x', 'ball.y'])
        >>> layout.places
        {'arm': [0, 1], 'ball.x': [2], 'ball.y': [3]}
        >>> layout.unflatten(row)["ball"]["y"].tolist()
        [3.0]
    """

    def __init__(self, space: spaces.Space, name: str) -> None:
        self._leaves, self._name = _leaves(space, (), name), name
        self.width = sum(leaf.width for leaf in self._leaves)

    @property
    def entries(self) -> list[str]:
        """Names of a nested dictionary's entries in order, with dots between keys; empty for a vector."""
        return [".".join(leaf.path) for leaf in self._leaves if leaf.path]

    @property
    def places(self) -> dict[str, list[int]]:
        """The columns of a row that hold each entry of a nested dictionary; empty for a vector."""
        places, first = {}, 0
        for leaf in self._leaves:
            if leaf.path:
                places[".".join(leaf.path)] = list(range(first, first + leaf.width))
            first += leaf.width
        return places

    @property
    def sizes(self) -> set[int]:
        """Sizes of all dimensions."""
        return {size for leaf in self._leaves for size in leaf.shape}

    @property
    def shapes(self) -> list[tuple[tuple[str, ...], tuple[int, ...]]]:
        """Keys and shape of each entry. Two spaces of goals can be compared if these are equal."""
        return [(leaf.path, leaf.shape) for leaf in self._leaves]

    def flatten(self, values: Any) -> np.ndarray:
        """Flattens values of the space with leading dimensions [...] to rows [..., width].

        Raises:
            ValueError: a value is not a finite number of float32; the message names it.
        """
        arrays = []
        for leaf in self._leaves:
            value = values
            for key in leaf.path:
                value = value[key]
            value = np.asarray(value)
            rows = value.reshape(*value.shape[: value.ndim - len(leaf.shape)], leaf.width)
            finite = np.abs(rows) <= _LARGEST
            if not finite.all():
                name, at = ".".join([self._name, *leaf.path]), np.argwhere(~finite)[0]
                raise ValueError(f"{name} {at[-1]} must be a finite number, got {rows[tuple(at)]}")
            arrays.append(rows)
        return arrays[0] if len(arrays) == 1 else np.concatenate(arrays, -1)

    def unflatten(self, rows: np.ndarray) -> Any:
        """Converts rows [..., width] to values of the space, rounded to its types; all arrays are copies."""
        nested: Any = {}
        first = 0
        for leaf in self._leaves:
            part = rows[..., first : first + leaf.width]
            part = (part if leaf.dtype.kind == "f" else np.rint(part)).astype(leaf.dtype)
            part = part.reshape((*rows.shape[:-1], *leaf.shape))
            first += leaf.width
            if not leaf.path:
                return part
            inner = nested
            for key in leaf.path[:-1]:
                inner = inner.setdefault(key, {})
            inner[leaf.path[-1]] = part
        return nested


def _leaves(space: spaces.Space, path: tuple[str, ...], name: str) -> list[_Leaf]:
    if isinstance(space, spaces.Dict):
        parts = sorted(space.spaces.items())
        if not parts:
            raise ValueError(f"{name} has an empty dictionary")
        return [leaf for key, part in parts for leaf in _leaves(part, (*path, key), name)]
    if space.shape is None or space.dtype is None or space.dtype.kind not in "fiub":
        where = f" in {'.'.join(path)}" if path else ""
        raise ValueError(f"{name} must be numbers or a dictionary of arrays, got {space}{where}")
    return [_Leaf(path, space.shape, np.dtype(space.dtype))]
