"""Refuses parts of a replay buffer with which relabeling would silently give wrong results."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from tensordict import TensorDictBase
from torchrl.data.replay_buffers.sample_units import Sequence
from torchrl.data.replay_buffers.samplers import (
    ConsumingSampler,
    PrioritizedSliceSampler,
    Sampler,
    SamplerEnsemble,
    SliceSampler,
)
from torchrl.data.replay_buffers.storages import ListStorage, Storage, TensorStorage
from torchrl.data.replay_buffers.writers import ImmutableDatasetWriter, RoundRobinWriter, Writer

from torchrl_her.replay_buffers.n_steps import STEPS_KEY
from torchrl_her.replay_buffers.options import HindsightBase, HindsightOptions
from torchrl_her.torchrl_private import buffers_of, samplers_in, unit_of

SHARED = (
    "workers send episodes and the learner extends. Leave replay_buffer= of the collector out, and extend "
    "the buffer with what the collector yields"
)

MASK = ("collector", "mask")  # TorchRL's mask of the rows that are not padding


def samplers_of(storage: Storage) -> Iterator[Sampler]:
    """Yields the samplers of all buffers that read a storage; for an ensemble, the samplers inside it."""
    waiting: list[Any] = [getattr(buffer, "sampler", None) for buffer in buffers_of(storage)]
    while waiting:
        sampler = waiting.pop()
        if isinstance(sampler, SamplerEnsemble):
            waiting.extend(samplers_in(sampler))
        elif isinstance(sampler, Sampler):
            yield sampler


def refuse_beside_writer(
    name: str, storage: Storage, transitions: TensorDictBase, options: HindsightOptions, *, runs: int
) -> None:
    """Raises a ValueError if a storage, sampler or batch does not fit a writer of R runs."""
    refuse_padded(name, transitions)
    if storage.ndim > 1:
        raise ValueError(f"{name} needs a storage of 1 dimension, got one of {storage.ndim}")
    refuse_n_steps(name, transitions)
    refuse_consuming(name, storage)
    refuse_slices(name, storage)
    refuse_priorities(name, storage, transitions)
    refuse_other_runs(name, storage, transitions, runs=runs)
    refuse_copies_in_slices(name, storage, options)


def refuse_shared(name: str, storage: Storage) -> None:
    """Raises a RuntimeError if a buffer of a storage is shared between processes."""
    if any(getattr(buffer, "shared", False) for buffer in buffers_of(storage)):
        raise RuntimeError(f"{name} cannot work in a buffer that is shared between processes: {SHARED}")


def refuse_unordered(name: str, storage: Storage) -> None:
    """Raises a ValueError if a buffer does not write real transitions in the order of time to a storage."""
    for buffer in buffers_of(storage):
        writer = getattr(buffer, "writer", None)
        if isinstance(writer, HindsightBase) and writer.k > 0:
            raise ValueError(
                f"{name} needs real transitions, but a {type(writer).__name__} with k={writer.k} relabels "
                "them: use one of the two"
            )
        if isinstance(writer, Writer) and not isinstance(writer, RoundRobinWriter | ImmutableDatasetWriter):
            raise ValueError(
                f"{name} needs transitions in the order of time, which {type(writer).__name__} does not "
                "keep: use RoundRobinWriter"
            )


def refuse_padded(name: str, transitions: TensorDictBase) -> None:
    """Raises a ValueError if trajectories were split and padded."""
    if MASK in transitions.keys(True):
        raise ValueError(
            f"{name} needs batches that are not split and padded: make the collector with split_trajs=False"
        )


def refuse_stages(name: str, transitions: TensorDictBase, options: HindsightOptions) -> None:
    """Raises a ValueError if transitions have stages, since one reward would relabel all of them."""
    if options.k > 0 and options.stage_key in transitions.keys(True):
        raise ValueError(
            f"{name} got transitions with a stage ({options.stage_key!r}), but has one reward for all "
            "stages: use HERWriter(stages=[...]), or another stage_key if that entry is something else"
        )


def refuse_priorities(name: str, storage: Storage, transitions: TensorDictBase) -> None:
    """Raises a ValueError if a batch [N, T] brings its own priorities, which TorchRL cannot set."""
    for buffer in buffers_of(storage):
        key = getattr(buffer, "priority_key", None)
        if transitions.ndim > 1 and key is not None and transitions.get(key, None) is not None:
            raise ValueError(
                f"{name} got a batch {list(transitions.shape)} that holds priorities ({key!r}): leave them "
                f"out, batch.exclude({key!r}), or extend with flat batches"
            )


def has_slices(storage: Storage) -> bool:
    """Returns whether sequences are sampled from a storage."""
    units = (unit_of(buffer) for buffer in buffers_of(storage))
    return any(isinstance(sampler, SliceSampler) for sampler in samplers_of(storage)) or any(
        isinstance(unit, Sequence) for unit in units
    )


def refuse_slices(name: str, storage: Storage) -> None:
    """Raises a ValueError if TorchRL samples wrong sequences from a storage of this kind.

    A sampler of slices marks their ends in the stored rows of a list storage. In a full storage of several
    dimensions, the slices of a prioritized sampler are no sequences.
    """
    if isinstance(storage, ListStorage) and has_slices(storage):
        raise ValueError(
            f"{name} cannot work with slices of a {type(storage).__name__}: the sampler would mark their "
            "ends in its stored rows; use a LazyTensorStorage"
        )
    by_priority = any(isinstance(sampler, PrioritizedSliceSampler) for sampler in samplers_of(storage))
    if storage.ndim > 1 and by_priority:
        raise ValueError(
            f"{name} cannot work with a PrioritizedSliceSampler over a storage of {storage.ndim} "
            "dimensions: it finds no sequences once the storage is full; use ndim=1"
        )


def refuse_consuming(name: str, storage: Storage) -> None:
    """Raises a ValueError if transitions are removed when they are sampled."""
    if any(isinstance(sampler, ConsumingSampler) for sampler in samplers_of(storage)):
        raise ValueError(
            f"{name} cannot work in a buffer that consumes its transitions (consume_after_n_samples, "
            "ConsumingSampler): new ones replace sampled ones, so the order of time is lost. "
            "Use another sampler"
        )


def refuse_n_steps(name: str, transitions: TensorDictBase) -> None:
    """Raises a ValueError if transitions span several steps already."""
    if transitions.get(STEPS_KEY, None) is not None:
        raise ValueError(
            f"{name} got transitions that span several steps (entry {STEPS_KEY!r}, as MultiStep and "
            "MultiStepTransform write it): goals that are passed on the way would be missed. Leave that "
            f"transform out, and give {name} the options n_steps and gamma"
        )


def refuse_copies_in_slices(name: str, storage: Storage, options: HindsightOptions) -> None:
    """Raises a ValueError if sequences are sampled from a storage of single transitions.

    The sequences would be copies of one transition, or overlap.
    """
    if not has_slices(storage):
        return
    if options.k > 0 and options.per == "transition":
        raise ValueError(
            f"under a sampler of slices, {name} needs per='episode': with per='transition' a slice "
            "would hold copies of one transition for several goals, and no sequence"
        )
    if options.n_steps > 1:
        raise ValueError(
            f"under a sampler of slices, {name} needs n_steps=1, got {options.n_steps}: "
            "the steps of a slice follow each other already"
        )


def refuse_other_runs(name: str, storage: Storage, transitions: TensorDictBase, *, runs: int) -> None:
    """Raises a ValueError if a batch, the storage or a sampler is not for the writer's number of runs."""
    if runs == 1:
        return
    if transitions.ndim != 2 or len(transitions) % runs:
        raise ValueError(
            f"{name}(runs={runs}) takes batches [R * N, T], {runs} equal blocks of "
            f"environments, got {list(transitions.shape)}"
        )
    if not isinstance(storage, TensorStorage) or storage.max_size % runs:
        raise ValueError(
            f"{name}(runs={runs}) needs a LazyTensorStorage or PackedStorage of {runs} "
            f"equal blocks, got a {type(storage).__name__} of {storage.max_size:,} rows"
        )
    for sampler in samplers_of(storage):
        if getattr(sampler, "runs", 1) != runs:
            raise ValueError(
                f"{name}(runs={runs}) needs a RunsSampler or RunsPrioritizedSampler of {runs} "
                f"runs, got a {type(sampler).__name__} of {getattr(sampler, 'runs', 1)}"
            )
