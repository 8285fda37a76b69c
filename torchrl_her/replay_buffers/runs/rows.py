"""Builds the rows to be written from collected transitions and the entries that copies of them change."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, is_leaf_nontensor
from torch import Tensor

from torchrl_her.replay_buffers.runs.written import WrittenRows


def join_rows(
    rows: TensorDictBase,
    virtual: WrittenRows | None,
    real: WrittenRows,
    *,
    exclude: Sequence[NestedKey],
    virtual_key: NestedKey | None,
) -> TensorDictBase:
    """Builds transitions for the storage, run after run, in each run first virtual and then real ones.

    Args:
        rows: [n], collected transitions.
        virtual: virtual transitions of some runs; None if there are none.
        real: real transitions of the same runs.

    Keyword Args:
        exclude: entries of ``rows`` that are left out.
        virtual_key: key of a bool [..., 1] that marks virtual transitions; None for no mark.
    """
    both = [real] if virtual is None else [virtual, real]

    def join(parts: list[Tensor]) -> Tensor:
        """Joins a tensor of the virtual and one of the real transitions, run after run."""
        split = [part.split(written.counts) for part, written in zip(parts, both, strict=True)]
        return torch.cat([part for run in zip(*split, strict=True) for part in run])

    changed = list(dict.fromkeys(key for written in both for key in written.changes))
    same = rows.exclude(*exclude, *changed)
    root = join([written.root for written in both])
    if all(written.last is written.root for written in both):  # transitions of single steps
        out = take_rows(same, root)
    else:
        out = take_rows(same.exclude("next"), root)
        out.set("next", take_rows(same.get("next"), join([written.last for written in both])))
    for key in changed:
        out.set(key, join([written.entry(rows, key) for written in both]))
    if virtual_key is not None:
        marks = [torch.full_like(written.root, written is virtual, dtype=torch.bool) for written in both]
        out.set(virtual_key, join(marks).unsqueeze(-1))
    return out


def take_rows(transitions: TensorDictBase, index: Tensor) -> TensorDictBase:
    """Copies some transitions [m], with their entries that are not tensors.

    Args:
        transitions: [n].
        index: [m] int64, positions.

    Example:
        >>> transitions = TensorDict({"x": torch.tensor([[5], [6], [7]])}, [3])
        >>> take_rows(transitions, torch.tensor([2, 0]))["x"].tolist()
        [[7], [5]]
    """
    out = transitions.apply(partial(_take, index=index), batch_size=index.shape, is_leaf=is_leaf_nontensor)
    return TensorDict(batch_size=index.shape, device=index.device) if out is None else out


def _take(entry: Any, index: Tensor) -> Any:
    """Copies rows of an entry. Torch indexes single numbers several times faster than rows of one number."""
    if not isinstance(entry, Tensor):
        return entry[index]
    if entry.shape[1:].numel() == 1:
        return entry.flatten().index_select(0, index).view(-1, *entry.shape[1:])
    return entry.index_select(0, index)
