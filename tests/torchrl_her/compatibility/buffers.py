"""Replay buffers of each kind that TorchRL has, with HERWriter or HERSampleUnit in them."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import ray
import torch
from tensordict import TensorDictBase
from torch import multiprocessing
from torch.distributed import rpc
from torchrl.data import (
    LazyMemmapStorage,
    LazyStackStorage,
    LazyTensorStorage,
    ListStorage,
    PrioritizedSampler,
    PrioritizedSliceSampler,
    RandomSampler,
    RayReplayBuffer,
    RemoteTensorDictReplayBuffer,
    ReplayBufferEnsemble,
    SamplerWithoutReplacement,
    SliceSampler,
    SliceSamplerWithoutReplacement,
    TensorDictReplayBuffer,
)

from .audit import Log, Rows, check_slices, check_stored, check_written
from .collect import ENVS, Batches, single
from .parts import BATCH, EPISODES, FLAT, GRID, ROOM, WRITER, K, is_writer, make_buffer, parts_in, shaped

SLICE = 3  # steps
FULL = 90  # rows of a buffer in which new ones take the places of old ones
SAMPLES = 6
BOTH = {False, True}  # real rows and virtual ones
_TRAJECTORY = ("collector", "traj_ids")


@dataclass(frozen=True)
class Sampling:
    """A sampler.

    Args:
        make: makes it for a number of rows; None for the default.
        slices: whether it draws sequences.
        once: whether it draws each sequence once, and raises an error when there is none left.
        priorities: whether it is told priorities.
        options: of the buffer.
    """

    make: Callable[[int], Any] | None
    slices: bool = False
    once: bool = False
    priorities: bool = False
    options: dict[str, Any] = field(default_factory=dict)


_SLICES = {"slice_len": SLICE, "traj_key": _TRAJECTORY}

SAMPLERS: dict[str, Sampling] = {
    "`RandomSampler`": Sampling(lambda rows: RandomSampler()),
    "`PrioritizedSampler`": Sampling(
        lambda rows: PrioritizedSampler(rows, alpha=0.7, beta=0.5), priorities=True
    ),
    "`SamplerWithoutReplacement`": Sampling(lambda rows: SamplerWithoutReplacement()),
    "`SliceSampler`": Sampling(lambda rows: SliceSampler(**_SLICES), slices=True),
    "`PrioritizedSliceSampler`": Sampling(
        lambda rows: PrioritizedSliceSampler(rows, alpha=0.7, beta=0.5, **_SLICES),
        slices=True,
        priorities=True,
    ),
    "`SliceSamplerWithoutReplacement`": Sampling(
        lambda rows: SliceSamplerWithoutReplacement(**_SLICES), slices=True, once=True
    ),
    "`consume_after_n_samples`": Sampling(None, options={"consume_after_n_samples": 1}),
}

_FLAT_STORAGES = {
    "`LazyTensorStorage`": LazyTensorStorage,
    "`LazyMemmapStorage`": LazyMemmapStorage,
    "`ListStorage`": ListStorage,
    "`LazyStackStorage`": LazyStackStorage,
}
TENSOR, TWO_DIMENSIONS, ENSEMBLE = (
    "`LazyTensorStorage`",
    "`LazyTensorStorage(ndim=2)`",
    "`ReplayBufferEnsemble`",
)
REMOTE, RAY = "`RemoteTensorDictReplayBuffer`", "`RayReplayBuffer`"
STORAGES = (*_FLAT_STORAGES, TWO_DIMENSIONS, ENSEMBLE, REMOTE, RAY)
Cells = Sequence[tuple[str, str]]
ROLES = (WRITER, EPISODES, "`HERSampleUnit`")


def episodes(env: int = 0) -> Batches:
    """Flat batches of whole episodes of three environments."""
    return single(env=env, num_envs=ENVS, env_ids=False, trajs_per_batch=4, traj_format="cat")


def steps() -> Batches:
    """Batches [N, T] of three environments."""
    return single(num_envs=ENVS, env_ids=False)


def try_local(storage: str, sampler: str, role: str, *, room: int) -> None:
    """Audits a buffer in this process.

    Args:
        storage, sampler, role: of STORAGES, SAMPLERS and ROLES.
        room: rows that the storage takes. All that are written are audited, unless they are more.

    Raises:
        AssertionError: a row is wrong. Any other error is a refusal.
    """
    sampling, part = SAMPLERS[sampler], role if is_writer(role) else FLAT
    options = {"batch_size": BATCH if room > FULL else 4 * SLICE, **sampling.options}
    if sampling.make is not None:
        options["sampler"] = sampling.make(room)
    if storage == ENSEMBLE:
        _try_ensemble(part, sampling, room=room)
        return
    if storage == TWO_DIMENSIONS:
        part = role if is_writer(role) else GRID
        made, batches = partial(LazyTensorStorage, room, ndim=2), steps()
    else:
        made, batches = partial(_FLAT_STORAGES.get(storage, LazyTensorStorage), room), episodes()
    kind = RemoteTensorDictReplayBuffer if storage == REMOTE else TensorDictReplayBuffer
    buffer, log = make_buffer(part, made, kind, **options), Log(batches)
    for batch in batches:
        buffer.extend(shaped(part, batch))
        if not sampling.once:
            draw(buffer, log, sampling, samples=1)
    _audit_stored(part, buffer, log, whole=room > FULL)
    kinds = draw(buffer, log, sampling, samples=2 if sampling.once else SAMPLES)
    assert kinds == BOTH


def _try_ensemble(part: str, sampling: Sampling, *, room: int) -> None:
    members, fed = [], []
    for env in (0, 100):
        options = dict(sampling.options)
        if sampling.make is not None:
            options["sampler"] = sampling.make(room)
        member, batches = make_buffer(part, partial(LazyTensorStorage, room), **options), episodes(env)
        for batch in batches:
            member.extend(batch)
        _audit_stored(part, member, Log(batches), whole=room > FULL)
        members.append(member)
        fed += batches
    ensemble = ReplayBufferEnsemble(*members, sample_from_all=True, batch_size=BATCH)
    assert draw(ensemble, Log(fed), sampling, priorities=False) == BOTH


def _audit_stored(part: str, buffer: Any, log: Log, *, whole: bool) -> None:
    stored = buffer.storage[:]
    if isinstance(stored, list):
        stored = torch.stack(stored)
    if not is_writer(part):
        if whole:
            check_stored(stored, log)
        return
    rows = Rows(stored, log)
    if whole:
        check_written(rows, log, held_back=buffer.writer.held_back, k=K, per=buffer.writer.options.per)


def draw(
    buffer: Any, log: Log, sampling: Sampling, *, samples: int = SAMPLES, priorities: bool = True
) -> set[bool]:
    """Audits batches drawn from a buffer, and gives their rows priorities.

    Returns:
        Whether rows were virtual: BOTH if there were virtual rows and real ones.

    Raises:
        AssertionError: a row is wrong, or a slice is none.
    """
    kinds: set[bool] = set()
    for _ in range(samples):
        batch = buffer.sample()
        size, cut = batch.numel(), None
        if sampling.slices:
            cut = (torch.arange(size) + 1) % SLICE == 0
        rows = Rows(batch, log, cut)
        if sampling.slices:
            check_slices(rows, SLICE)
        kinds |= set(rows.virtual.tolist())
        if sampling.priorities and priorities:
            batch["td_error"] = torch.rand(batch.shape)
            buffer.update_tensordict_priority(batch)
    return kinds


def try_remote(cells: Cells) -> list[str]:
    """Audits buffers that another process owns, by torch.distributed.rpc.

    Args:
        cells: of each, its sampler and its role.

    Returns:
        For each cell its error, or nothing.
    """
    with tempfile.TemporaryDirectory() as folder:
        owner = multiprocessing.get_context("fork").Process(target=_rpc, args=(1, folder), daemon=True)
        owner.start()
        _rpc(0, folder)
        return [_outcome(_try_remote, *cell) for cell in cells]


def _rpc(rank: int, folder: str) -> None:
    options = rpc.TensorPipeRpcBackendOptions(init_method=f"file://{folder}/rpc", num_worker_threads=4)
    rpc.init_rpc(f"rank{rank}", rank=rank, world_size=2, rpc_backend_options=options)
    if rank > 0:
        rpc.shutdown()  # waits for the other one


def _try_remote(sampler: str, role: str) -> None:
    owned = rpc.remote("rank1", _make_remote, args=(sampler, role))
    _try_elsewhere(owned.rpc_sync(), lambda: rpc.rpc_sync("rank1", _stored, args=(owned,)), sampler, role)


def _stored(owned: rpc.RRef) -> TensorDictBase:
    return owned.local_value().storage[:]


def _make_remote(sampler: str, role: str) -> RemoteTensorDictReplayBuffer:
    part, sampling = role if is_writer(role) else FLAT, SAMPLERS[sampler]
    options = dict(sampling.options)
    if sampling.make is not None:
        options["sampler"] = sampling.make(ROOM)
    return make_buffer(part, kind=RemoteTensorDictReplayBuffer, **options)


def try_ray(cells: Cells) -> list[str]:
    """Audits buffers that Ray actors own.

    Args:
        cells: of each, its sampler and its role.

    Returns:
        For each cell its error, or nothing.
    """
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    quiet = {"include_dashboard": False, "configure_logging": False, "log_to_driver": False}
    ray.init(num_cpus=1, _node_ip_address="127.0.0.1", **quiet)  # it then listens on the loopback alone
    try:
        return [_outcome(_try_ray, *cell) for cell in cells]
    finally:
        ray.shutdown()


def _try_ray(sampler: str, role: str) -> None:
    options = dict(SAMPLERS[sampler].options)
    if (make := SAMPLERS[sampler].make) is not None:
        options["sampler"] = partial(make, ROOM)
    buffer = RayReplayBuffer(
        replay_buffer_cls=TensorDictReplayBuffer,
        remote_config={"num_cpus": 0},
        storage=partial(LazyTensorStorage, ROOM),
        batch_size=BATCH,
        **parts_in(role if is_writer(role) else FLAT),
        **options,
    )
    try:
        # A unit lets nobody read all rows from outside.
        _try_elsewhere(buffer, (lambda: buffer[:]) if is_writer(role) else None, sampler, role)
    finally:
        buffer.close()


def _outcome(function: Callable[..., None], *arguments: Any) -> str:
    try:
        function(*arguments)
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return ""


def _try_elsewhere(buffer: Any, read: Callable[[], TensorDictBase] | None, sampler: str, role: str) -> None:
    batches = episodes()
    log = Log(batches)
    for batch in batches:
        buffer.extend(batch)
    if read is not None and is_writer(role):
        per = "episode" if role == EPISODES else "transition"
        check_written(Rows(read(), log), log, held_back=0, k=K, per=per)
    elif read is not None:
        check_stored(read(), log)
    assert draw(buffer, log, SAMPLERS[sampler]) == BOTH
