"""Access to private attributes of TorchRL's and tensordict's objects, all in one place.

All of them exist in TorchRL 0.14.0, 0.14.1 and the nightly build of 2026-10-27, and in tensordict 0.14.2,
0.14.3 and 0.15.3. Subclasses elsewhere also use private attributes that they inherit.
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import BaseCollector
from torchrl.data import ReplayBuffer
from torchrl.data.replay_buffers.samplers import Sampler, SamplerEnsemble
from torchrl.data.replay_buffers.storages import Storage, TensorStorage
from torchrl.data.replay_buffers.writers import Writer

# Storages


def buffers_of(storage: Storage) -> list[Any]:
    """Returns the buffers that use a storage."""
    return storage._attached_entities


def is_full(storage: Storage) -> bool:
    """Returns whether all rows of a storage were written."""
    return storage._is_full


def revision_of(storage: Storage) -> int:
    """Returns a number that differs after each write."""
    return storage._mutation_revision


def count_a_write(storage: Storage) -> None:
    """Changes the storage's revision, by which caches notice a write."""
    storage._bump_mutation_revision()


def last_written(storage: Storage) -> Any:
    """Returns where a storage was written last; None if it keeps no record."""
    return getattr(storage, "_last_cursor_index", None)


def set_last_written(storage: Storage, cursor: Any) -> None:
    """Sets where a storage was written last; slices end there."""
    storage._set_last_cursor(cursor)


def set_length(storage: TensorStorage, length: int) -> None:
    """Sets the number of rows of a storage that are filled."""
    storage._len = length


def whole_of(storage: TensorStorage) -> TensorDictBase:
    """Returns all rows of a storage, unfilled ones too."""
    return storage._storage


# Other parts of a buffer


def generator_of(part: Storage | Sampler) -> torch.Generator | None:
    """Returns the generator of a buffer's random numbers."""
    return part._rng


def unit_of(buffer: ReplayBuffer) -> Any:
    """Returns the function that expands the rows that a buffer has drawn; None if it has none."""
    return getattr(buffer, "_sample_unit", None)


def functions_on_batches(buffer: ReplayBuffer) -> list[Any]:
    """Returns a buffer's ``collate_fn`` and the functions of its transforms, called with each batch."""
    return [buffer._collate_fn, *(getattr(each, "func", None) for each in buffer._transform or ())]


def samplers_in(ensemble: SamplerEnsemble) -> list[Sampler]:
    """Returns the samplers of an ensemble's members."""
    return ensemble._samplers


def capacity_of(sampler: Sampler) -> int:
    """Returns the number of rows for which a prioritized sampler has priorities; 0 for others."""
    return getattr(sampler, "_max_capacity", 0)


def next_row(writer: Writer) -> int | None:
    """Returns the next row of a round-robin writer; None for other writers."""
    return getattr(writer, "_cursor", None)


# Collectors and modules


def carrier_of(collector: BaseCollector) -> TensorDictBase | None:
    """Returns the step with which a collector resumes; None if it keeps none."""
    return getattr(collector, "_carrier", None)


def set_carrier(collector: BaseCollector, carrier: TensorDictBase) -> None:
    """Sets the step with which a collector resumes."""
    collector._carrier = carrier


def set_next_ids(collector: BaseCollector, state: dict[str, Any]) -> None:
    """Sets the trajectory ids that a collector gives next."""
    collector._traj_pool.load_state_dict(state)


def has_keyword_arguments(module: TensorDictModuleBase) -> bool:
    """Returns whether a module is called with more than its ``in_keys``."""
    return bool(module._kwargs or module._get_kwargs)
