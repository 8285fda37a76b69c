"""Private names of TorchRL's and tensordict's objects, which are read here alone.

All of them were seen in TorchRL 0.14.0, 0.14.1 and the nightly build of 2026-10-27, and in tensordict 0.14.2,
0.14.3 and 0.15.3. Subclasses also use what they inherit.
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
    """The buffers that use a storage."""
    return storage._attached_entities


def is_full(storage: Storage) -> bool:
    """Whether all rows of a storage were written."""
    return storage._is_full


def revision_of(storage: Storage) -> int:
    """Returns a number that differs after each write."""
    return storage._mutation_revision


def count_a_write(storage: Storage) -> None:
    """Changes the storage's revision, for whatever remembers what it has read."""
    storage._bump_mutation_revision()


def last_written(storage: Storage) -> Any:
    """Where a storage was written last; None if it does not say."""
    return getattr(storage, "_last_cursor_index", None)


def set_last_written(storage: Storage, cursor: Any) -> None:
    """Says where a storage was written last; slices end there."""
    storage._set_last_cursor(cursor)


def set_length(storage: TensorStorage, length: int) -> None:
    """Says how many rows of a storage are filled."""
    storage._len = length


def whole_of(storage: TensorStorage) -> TensorDictBase:
    """All rows of a storage, those that are not filled, too."""
    return storage._storage


# Other parts of a buffer


def generator_of(part: Storage | Sampler) -> torch.Generator | None:
    """The source of a buffer's random numbers."""
    return part._rng


def unit_of(buffer: ReplayBuffer) -> Any:
    """Returns the function that expands the rows that a buffer has drawn; None if it has none."""
    return getattr(buffer, "_sample_unit", None)


def functions_on_batches(buffer: ReplayBuffer) -> list[Any]:
    """The ``collate_fn`` of a buffer and the functions of its transforms, called with each batch."""
    return [buffer._collate_fn, *(getattr(each, "func", None) for each in buffer._transform or ())]


def samplers_in(ensemble: SamplerEnsemble) -> list[Sampler]:
    """The samplers of its members."""
    return ensemble._samplers


def capacity_of(sampler: Sampler) -> int:
    """For how many rows a prioritized sampler has priorities; 0 for others."""
    return getattr(sampler, "_max_capacity", 0)


def next_row(writer: Writer) -> int | None:
    """Where a writer writes next; None if it does not go round."""
    return getattr(writer, "_cursor", None)


# Collectors and modules


def carrier_of(collector: BaseCollector) -> TensorDictBase | None:
    """Returns the step with which a collector resumes; None if it keeps none."""
    return getattr(collector, "_carrier", None)


def set_carrier(collector: BaseCollector, carrier: TensorDictBase) -> None:
    """Lets a collector resume with another step."""
    collector._carrier = carrier


def set_next_ids(collector: BaseCollector, state: dict[str, Any]) -> None:
    """Says which trajectory ids a collector gives next."""
    collector._traj_pool.load_state_dict(state)


def has_keyword_arguments(module: TensorDictModuleBase) -> bool:
    """Whether a module is called with more than its ``in_keys``."""
    return bool(module._kwargs or module._get_kwargs)
