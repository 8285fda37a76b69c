"""Each sampler and storage of TorchRL with HERWriter or HERSampleUnit: no transition is silently wrong."""

from __future__ import annotations

from functools import partial

import pytest
import torch

from .buffers import FULL, RAY, REMOTE, ROLES, SAMPLERS, STORAGES, TENSOR, try_local
from .parts import ROOM
from .program import run_jobs
from .tables import BUFFERS, name_of, outcome_of

pytest.importorskip("ray", exc_type=ImportError)

LOCAL = [name for name in STORAGES if name not in (REMOTE, RAY)]
# Each time: all samplers with the usual storage, and all storages with these.
_SAMPLE = ("`RandomSampler`", "`SliceSampler`")
_CELLS = [
    pytest.param(storage, sampler, marks=() if storage == TENSOR or sampler in _SAMPLE else pytest.mark.full)
    for storage in LOCAL
    for sampler in SAMPLERS
]


@pytest.mark.filterwarnings("ignore:The PyTorch API of nested tensors:UserWarning")  # in TorchRL's ensembles
@pytest.mark.filterwarnings("ignore:SliceSampler returned a short flat batch:UserWarning")
@pytest.mark.parametrize(("storage", "sampler"), _CELLS)
@pytest.mark.parametrize("room", [ROOM, FULL], ids=["all rows", "new rows over old ones"])
def test_a_buffer_is_right_or_refused(storage: str, sampler: str, room: int) -> None:
    outcomes = []
    for role in ROLES:
        torch.manual_seed(0)
        outcomes.append(outcome_of(partial(try_local, storage, sampler, role, room=room)))
    assert tuple(outcomes) == BUFFERS[storage][sampler]


@pytest.mark.full
@pytest.mark.long
@pytest.mark.parametrize(("job", "storage"), [("remote", REMOTE), ("ray", RAY)], ids=["rpc", "ray"])
def test_a_buffer_of_another_process_is_right_or_refused(job: str, storage: str) -> None:
    if job == "remote" and not torch.distributed.rpc.is_available():
        pytest.skip("this torch was built without torch.distributed.rpc")
    cells = [(sampler, role) for sampler in SAMPLERS for role in ROLES]
    ((errors, said),) = run_jobs([(job, cells)])
    assert errors is not None, said
    outcomes = iter([name_of(error) if error else "works" for error in errors])
    assert {sampler: tuple(next(outcomes) for _ in ROLES) for sampler in SAMPLERS} == BUFFERS[storage]


def test_the_table_has_each_buffer() -> None:
    assert list(BUFFERS) == list(STORAGES)
    assert all(list(row) == list(SAMPLERS) for row in BUFFERS.values())
