"""Batches that mix a run's own transitions with demonstrations."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import TensorDictReplayBuffer

from torchrl_her.demonstrations.dataset import Demonstrations
from torchrl_her.objectives.cloning import DEMONSTRATION
from torchrl_her.replay_buffers.runs.buffer import runs_of, sizes_of
from torchrl_her.replay_buffers.writer import HERWriter
from torchrl_her.trainers.learner import WEIGHT


def write_demonstrations(
    buffer: TensorDictReplayBuffer, demonstrations: Demonstrations, *, run: int = 0
) -> None:
    """Writes demonstrations into a run's block of a buffer, relabeled as the buffer's writer does it.

    Args:
        buffer: buffer with a :class:`~torchrl_her.HERWriter`.
        demonstrations: demonstrations with the run's reward; see
            :func:`~torchrl_her.demonstrations.with_reward`.

    Keyword Args:
        run: index of the run.

    Raises:
        TypeError: the buffer has another writer.
    """
    if not isinstance(buffer.writer, HERWriter):
        kind = type(buffer.writer).__name__
        raise TypeError(f"demonstrations need a buffer with a HERWriter, got a {kind}")
    place = buffer.storage.device
    rows = demonstrations.rows
    buffer.writer.extend_run(rows if place in (None, "auto") else rows.to(place), run)


def demonstration_rows(share: float, batch_size: int) -> int:
    """Number of demonstrations in a batch: the share of its rows, rounded, from 1 to all rows but one.

    Example:
        >>> demonstration_rows(0.125, 256), demonstration_rows(0.001, 256)
        (32, 1)
    """
    if not 0.0 < share < 1.0:
        raise ValueError(f"share must be in (0, 1), got {share}")
    if batch_size < 2:
        raise ValueError(f"batch_size must be at least 2 to mix two kinds of rows, got {batch_size}")
    return min(max(1, round(share * batch_size)), batch_size - 1)


class MixedReplay:
    """A replay buffer of a run's own transitions and one of demonstrations, sampled as one.

    In each batch the first rows are a run's own and the last ones demonstrations, which are marked by the
    flag ``demonstration``. Entries that only one of the buffers has are left out. Importance weights are
    divided by their mean in each of the two parts: demonstrations then have the same share of the weight as
    of the rows. New priorities go to the buffer that a row came from.

    New transitions are written into ``collected``; ``writer`` and ``len()`` are those of that buffer. A
    :class:`~torchrl_her.Trainer` takes this object in place of a buffer.

    Nair et al., Overcoming exploration in reinforcement learning with demonstrations, 2018 (arXiv
    1709.10089).

    Args:
        collected: the buffer that is trained from; for one run or several.
        demonstrations: buffer of demonstrations for the same number of runs, with the same transforms.

    Keyword Args:
        share: fraction of each batch that is demonstrations.
        batch_size: number of rows in a batch of one run, the same as the trainer's.

    Raises:
        ValueError: the share is not between 0 and 1, a batch has no room for both, or the buffers are for
            different numbers of runs; when sampling, the rows are not whole batches.

    Example:
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage
        >>> collected, shown = (TensorDictReplayBuffer(storage=LazyTensorStorage(9)) for _ in range(2))
        >>> for buffer, x in ((collected, 1.0), (shown, 2.0)):
        ...     _ = buffer.extend(TensorDict({"x": torch.full((5, 1), x)}, [5]))
        >>> mixed = MixedReplay(collected, shown, share=0.25, batch_size=4)
        >>> mixed.sample(8)["x"].flatten().tolist()
        [1.0, 1.0, 1.0, 2.0, 1.0, 1.0, 1.0, 2.0]
    """

    def __init__(
        self,
        collected: TensorDictReplayBuffer,
        demonstrations: TensorDictReplayBuffer,
        *,
        share: float = 0.125,
        batch_size: int = 256,
    ) -> None:
        if runs_of(collected) != runs_of(demonstrations):
            raise ValueError(
                "buffers must have the same number of runs, got "
                f"{runs_of(collected)} and {runs_of(demonstrations)}"
            )
        self.collected, self.demonstrations = collected, demonstrations
        self.writer, self.priority_key = collected.writer, collected.priority_key
        self.runs, self.batch_size = runs_of(collected), batch_size
        self.shown = demonstration_rows(share, batch_size)

    def __len__(self) -> int:
        return len(self.collected)

    def extend(self, data: TensorDictBase) -> Tensor:
        """Writes a collected batch into the buffer of the runs' own transitions."""
        return self.collected.extend(data)

    def sample(self, batch_size: int) -> TensorDictBase:
        """Samples rows [R * S * B]: R equal blocks, one for each run, of S batches of B rows.

        The ``index`` of a demonstration is its row plus the capacity of ``collected``, so that each row has
        its own index.
        """
        steps, rest = divmod(batch_size, self.runs * self.batch_size)
        if rest or not steps:
            raise ValueError(
                f"batch_size must be a positive multiple of {self.runs * self.batch_size}, got {batch_size}"
            )
        if not all(sizes_of(self.demonstrations)):
            raise RuntimeError("some runs have no demonstrations: write them with write_demonstrations")
        parts = []
        for buffer, count in (
            (self.collected, self.batch_size - self.shown),
            (self.demonstrations, self.shown),
        ):
            rows = buffer.sample(self.runs * steps * count).view(self.runs, steps, count)
            if (weight := rows.get(WEIGHT, None)) is not None:
                rows.set(WEIGHT, weight / weight.flatten(1).mean(1).view(-1, *[1] * (weight.ndim - 1)))
            flag = torch.full((*rows.shape, 1), buffer is not self.collected, device=rows["index"].device)
            parts.append(rows.set(DEMONSTRATION, flag))
        parts[1].set("index", parts[1].get("index") + self.collected.storage.max_size)
        known = [set(part.keys(True, True)) for part in parts]
        both = [part.select(*(known[0] & known[1])) for part in parts]
        mixed: TensorDictBase = torch.cat(both, 2)
        return mixed.reshape(batch_size)

    def update_tensordict_priority(self, rows: TensorDictBase) -> None:
        """Passes the new priority of each row to the sampler that it came from.

        Args:
            rows: [n], with ``index`` and the new priorities.
        """
        behind = self.collected.storage.max_size
        demonstrated = rows.get("index").reshape(len(rows)) >= behind
        if not bool(demonstrated.all()):
            self.collected.update_tensordict_priority(rows[~demonstrated])
        if bool(demonstrated.any()):
            demo_rows = rows[demonstrated]
            demo_rows.set("index", demo_rows.get("index") - behind)
            self.demonstrations.update_tensordict_priority(demo_rows)
