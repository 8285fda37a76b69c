"""Sum trees of several runs, for drawing rows in proportion to their priorities."""

from __future__ import annotations

import ctypes
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from torchrl_her.native.trees import load_trees

_FAN = 16  # children of a node: 64 bytes, one cache line
_TOPS = 32  # largest number of nodes at the top level, which have no parent


class SumTrees:
    """Sum trees of R runs, drawn from and updated together in a few tensor operations.

    Each run has ``capacity`` leaves, which are at least 0. Each node above holds the sum of its 16 children.
    A draw goes down from the top: at each node it takes the child in which its random number lies. Leaves and
    sums have single precision. The random number has double precision on its way down, so that even a million
    equal leaves are drawn equally often.

    Args:
        capacity: number of leaves of each run.

    Keyword Args:
        runs: R, the number of runs.
        native: whether draws and updates are made in C++ where that can be compiled, with the same result.
        device: device of the leaves.

    Raises:
        MemoryError: the memory does not suffice for the leaves.

    Example:
        >>> trees = SumTrees(4, runs=2)
        >>> trees.set(torch.tensor([0, 0, 1]), torch.tensor([0, 3, 2]), torch.tensor([1.0, 1.0, 5.0]))
        >>> trees.totals.tolist()
        [2.0, 5.0]
        >>> leaf, value = trees.draw(torch.tensor([[0.2, 0.7], [0.2, 0.7]], dtype=torch.float64))
        >>> leaf.tolist(), value.tolist()
        ([[0, 3], [2, 2]], [[1.0, 1.0], [5.0, 5.0]])
    """

    def __init__(
        self, capacity: int, *, runs: int = 1, native: bool = True, device: torch.device | str = "cpu"
    ) -> None:
        self.capacity, self.runs, self.native = capacity, runs, native
        height = 0
        while -(-capacity // _FAN**height) > _TOPS:
            height += 1
        tops = -(-capacity // _FAN**height)
        try:
            self._levels = [
                torch.zeros(runs, tops * _FAN**level, dtype=torch.float32, device=device)
                for level in range(height, -1, -1)
            ]
        except RuntimeError as error:  # torch raises a RuntimeError in place of a MemoryError
            raise MemoryError(f"there is not enough memory for {runs} x {capacity:,} priorities") from error

    @property
    def totals(self) -> Tensor:
        """Returns the sum of each run's leaves, [R] of float64."""
        return self._levels[-1].double().sum(-1)

    def get(self, run: int, count: int) -> Tensor:
        """Returns a copy of a run's first leaves, [count]."""
        return self._levels[0][run, :count].clone()

    def set(self, run: Tensor, leaf: Tensor, value: Tensor, *, sorted: bool = False) -> None:
        """Sets the values of some leaves, and updates the sums above them.

        Args:
            run, leaf: [n] int64, run and index of each leaf. For repeated leaves, the last value counts.
            value: [n], or one number for all.

        Keyword Args:
            sorted: whether most leaves follow each other, as for new rows; then the sums above them are
                computed only once.
        """
        node = run * self._levels[0].shape[1] + leaf
        value = value.to(self._levels[0].dtype).expand(node.shape)
        if (native := self._native()) is not None:
            value = value.contiguous()
            native.her_trees_set(*self._pointers(), len(node), node.data_ptr(), value.data_ptr())
            return
        self._levels[0].view(-1).index_copy_(0, node, value)
        for below, level in pairwise(self._levels):
            children = below.view(-1, _FAN)
            if len(node) >= len(children):  # with many leaves, computing all sums is just as fast
                level.copy_(_total(children).view_as(level))
                continue
            node = node // _FAN
            if sorted:
                node = node.unique_consecutive()
            level.view(-1).index_copy_(0, node, _total(children.index_select(0, node)))

    def clear(self, run: int) -> None:
        """Sets all leaves of a run to 0."""
        for level in self._levels:
            level[run] = 0.0

    def draw(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """Draws leaves in proportion to their values.

        Args:
            u: [R, n] of float64, uniform in [0, 1).

        Returns:
            ``(leaf, value)``, [R, n] each: never a leaf of value 0, except in a run whose leaves are all 0,
            where it is the last one.
        """
        top = self._levels[-1]
        sums = top.double().cumsum(-1)
        mass = u * sums[:, -1:]
        if (native := self._native()) is not None:
            leaf, value = (torch.empty(u.shape, dtype=dtype) for dtype in (torch.int64, torch.float32))
            pointers = (mass.data_ptr(), leaf.data_ptr(), value.data_ptr())
            native.her_trees_draw(*self._pointers(), u.shape[1], *pointers)
            return leaf.clamp_max_(self.capacity - 1), value
        node, mass = _descend(sums.unsqueeze(1).expand(-1, u.shape[1], -1), mass.unsqueeze(-1))
        node += torch.arange(0, top.numel(), top.shape[1], device=u.device).view(-1, 1, 1)
        node, mass = node.flatten(), mass.flatten(0, 1)
        for level in reversed(self._levels[:-1]):
            child, mass = _descend(level.view(-1, _FAN).index_select(0, node).cumsum(-1), mass)
            node = node * _FAN + child.squeeze(-1)
        leaves = self._levels[0]
        leaf = (node.view(u.shape) % leaves.shape[1]).clamp_max_(self.capacity - 1)
        return leaf, leaves.view(-1).index_select(0, node).view(u.shape)

    def _native(self) -> Any:
        """Returns the functions in C++ if the trees are on the CPU; None on a GPU or if they are missing."""
        return load_trees() if self.native and self._levels[0].device.type == "cpu" else None

    def _pointers(self) -> tuple[Any, Any, int, int]:
        """Returns the levels in the form that the C++ functions take."""
        height = len(self._levels)
        levels = (ctypes.c_void_p * height)(*[level.data_ptr() for level in self._levels])
        widths = (ctypes.c_int64 * height)(*[level.shape[1] for level in self._levels])
        return levels, widths, height, self.runs


def _total(children: Tensor) -> Tensor:
    """Returns the sums [n] over children [n, 16], rounded like the running sums that draws use."""
    return children.cumsum(-1)[:, -1]


def _descend(sums: Tensor, mass: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the child [..., 1] that each draw goes down to, and the mass left for it within that child.

    It is the first child whose running sum [..., c] is above the mass; never one of 0, unless all are 0.
    """
    total = sums[..., -1:]  # may be less than the mass because of rounding
    within = torch.minimum(mass.to(sums.dtype), torch.nextafter(total, torch.zeros_like(total)))
    child = (sums <= within).sum(-1, keepdim=True).clamp_max_(sums.shape[-1] - 1)
    before = sums.gather(-1, (child - 1).clamp_min_(0)).masked_fill_(child == 0, 0.0)
    return child, (mass - before).clamp_min_(0.0)
