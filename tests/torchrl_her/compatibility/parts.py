"""HERWriter and HERSampleUnit in buffers, and the audit of such a buffer as a whole."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from tensordict import TensorDictBase
from torchrl.data import LazyTensorStorage, ReplayBuffer, Storage, TensorDictReplayBuffer

from torchrl_her import HERSampleUnit, HERWriter

from .audit import Log, Rows, check_stored, check_written
from .tagged import reward_fn

K = 2  # virtual rows for each real one
ROOM = 3000  # rows; more than are ever written, so that nothing is overwritten
BATCH = 60

WRITER, EPISODES = "`HERWriter`", '`HERWriter(per="episode")`'
FLAT, GRID = "`HERSampleUnit`, flat storage", "`HERSampleUnit`, [T, N] storage"
PARTS = (WRITER, EPISODES, FLAT, GRID)


def is_writer(part: str) -> bool:
    return part in (WRITER, EPISODES)


def parts_in(part: str) -> dict[str, Any]:
    """The options of a buffer that put one of PARTS into it."""
    if is_writer(part):
        return {"writer": HERWriter(reward_fn, k=K, per="episode" if part == EPISODES else "transition")}
    unit = HERSampleUnit(reward_fn, k=K)
    return {"sample_unit": unit, "collate_fn": unit.relabel}


def make_buffer(
    part: str,
    storage: Callable[..., Storage] | None = None,
    kind: type[ReplayBuffer] = TensorDictReplayBuffer,
    **options: Any,
) -> Any:
    """A replay buffer with one of PARTS.

    Args:
        part: one of PARTS.
        storage: makes the storage, and takes ``ndim``; None for one in memory.
        kind: class of the buffer.
        **options: of the buffer.
    """
    storage = storage or partial(LazyTensorStorage, ROOM)
    made = storage(ndim=2) if part == GRID else storage()
    return kind(storage=made, **{"batch_size": BATCH, **parts_in(part), **options})


def shaped(part: str, batch: TensorDictBase) -> TensorDictBase:
    """A batch in the form in which a part's buffer takes it."""
    if part == FLAT:
        return batch.reshape(-1)
    return batch.reshape(-1, batch.shape[-1]) if part == GRID else batch


def audit(part: str, buffer: Any, log: Log, *, samples: int = 8) -> None:
    """Audits all that a buffer holds, and some batches drawn from it.

    Raises:
        AssertionError: a row is wrong, one was lost or doubled, or there are no virtual ones.
    """
    stored, marked = buffer.storage[:], False
    if is_writer(part):
        marked = buffer.writer.options.per == "episode"
        rows = Rows(stored, log, marked=marked)
        check_written(rows, log, held_back=buffer.writer.held_back, k=K, per=buffer.writer.options.per)
    else:
        check_stored(stored, log)
    for _ in range(samples):
        virtual = Rows(buffer.sample(), log, marked=marked).virtual
        assert virtual.any(), "no virtual row was sampled"
        assert not virtual.all(), "no real row was sampled"
