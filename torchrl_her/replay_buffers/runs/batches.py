"""Transitions of a batch, or held back from earlier ones, with the run and environment of each."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_her.replay_buffers.keys import TransitionKeys
from torchrl_her.replay_buffers.runs.written import take_rows
from torchrl_her.replay_buffers.streams import BY_ENV, find_streams, in_order

_NO_ROWS = TensorDict(batch_size=[0])  # made once, since most batches hold no rows back; never written to


@dataclass(frozen=True)
class Batch:
    """Transitions [n], oldest first.

    Attributes:
        rows: [n]; without entries if n = 0.
        kind: property that distinguishes environments.
        ids: [n] int64, the environment or trajectory of each transition.
        run: [n] int64, the run of each transition; None if there is only one.

    Example:
        >>> from torchrl_her import HindsightOptions
        >>> data = TensorDict({"x": torch.arange(8.0).view(4, 2)}, [4, 2])  # two environments of each run
        >>> batch = Batch.of(data, HindsightOptions().transition_keys(), runs=2)
        >>> batch.run.tolist(), batch.ids.tolist()
        ([0, 0, 0, 0, 1, 1, 1, 1], [0, 0, 1, 1, 2, 2, 3, 3])
        >>> batch.take(torch.tensor([1, 7])).without_run(0).rows["x"].tolist()
        [7.0]
    """

    rows: TensorDictBase
    kind: str
    ids: Tensor
    run: Tensor | None

    @classmethod
    def none(cls, runs: int) -> Batch:
        """Returns an empty batch of R runs."""
        ids = torch.empty(0, dtype=torch.int64)
        return cls(_NO_ROWS, "", ids, None if runs == 1 else ids)

    @classmethod
    def of(cls, data: TensorDictBase, keys: TransitionKeys, *, runs: int) -> Batch:
        """Makes a batch from a collector's rows, which are R equal blocks in the order of the runs."""
        kind, ids = find_streams(data, keys)
        run = None
        if runs > 1:
            run = torch.arange(runs, device=ids.device).repeat_interleave(len(ids) // runs)
        return cls(data.reshape(-1), kind, ids, run)

    def __len__(self) -> int:
        return len(self.ids)

    def after(self, held: Batch) -> Batch:
        """Returns the transitions that were held back, followed by those of this batch.

        Raises:
            ValueError: the environments of both are distinguished by different properties.
        """
        if len(held) == 0:
            return self
        if self.kind != held.kind:
            raise ValueError(
                f"open episodes were distinguished by {held.kind}, but this batch has {self.kind}: write all "
                "batches in one form, [N, T] or flat, and with the same kind of ids"
            )
        place = self.ids.device  # rows that are held back may come from a checkpoint
        run = None if held.run is None or self.run is None else torch.cat((held.run.to(place), self.run))
        ids, rows = torch.cat((held.ids.to(place), self.ids)), held.rows.to(place)
        if self.rows.device is None:  # lazy stacks can be joined only if both or none have a device set
            rows = rows.copy().clear_device_()
        return Batch(torch.cat((rows, self.rows)), self.kind, ids, run)

    def streams(self) -> Tensor:
        """Returns a number [n] for each environment or trajectory; numbers increase from run to run."""
        streams = in_order(self.ids) if self.kind == BY_ENV else self.ids
        return streams if self.run is None else streams + self.run * (int(streams.max()) + 1)

    def take(self, index: Tensor) -> Batch:
        """Returns copies of the transitions at the positions ``index`` [m]."""
        rows = take_rows(self.rows, index) if len(index) else _NO_ROWS
        run = None if self.run is None else self.run[index]
        return replace(self, rows=rows, ids=self.ids[index], run=run)

    def without_run(self, run: int) -> Batch:
        """Returns the transitions of all runs but one."""
        stays = self.run != run if self.run is not None else torch.zeros_like(self.ids, dtype=torch.bool)
        return self.take(stays.nonzero().squeeze(-1))

    def state_dict(self) -> dict[str, Any]:
        """Returns the transitions, their runs and their ids, as tensors and plain data."""
        return {
            "held_runs": torch.empty(0, dtype=torch.int64) if self.run is None else self.run.clone(),
            "held": self.rows.to_dict() if len(self) else None,
            "held_ids": self.ids.clone(),
            "held_kind": self.kind,
        }

    @classmethod
    def from_state(cls, state: dict[str, Any], *, runs: int) -> Batch:
        """Restores a batch of R runs from a :meth:`state_dict`."""
        ids, run, held = state["held_ids"].clone(), state["held_runs"].clone(), state["held"]
        rows: TensorDictBase = _NO_ROWS
        if held is not None:
            rows = TensorDict.from_dict(held, batch_size=ids.shape).clone()
        return cls(rows, state["held_kind"], ids, None if runs == 1 else run)
