"""Batches as each of TorchRL's collectors gives them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from tensordict import TensorDictBase
from torchrl.collectors import AsyncBatchedCollector, Collector, MultiAsyncCollector, MultiSyncCollector
from torchrl.data import MultiStep
from torchrl.envs import EnvBase, SerialEnv, TransformedEnv

import torchrl_her

from .tagged import TaggedEnv, make_policy

STEPS = 5  # of each environment in a batch; episodes go on from one batch to the next
BATCHES = 8
ENVS = 3  # in a batch of environments
COMMON = {"auto_register_policy_transforms": False}

Batches = list[TensorDictBase]


def make_env(env: int = 0, num_envs: int | None = None, run: int = 0, env_ids: bool = False) -> EnvBase:
    """A tagged environment, with the transform that writes ids of environments or without."""
    made = TaggedEnv(env, num_envs, run)
    return TransformedEnv(made, torchrl_her.EnvIds()) if env_ids else made


def single(
    *,
    num_envs: int | None,
    env_ids: bool,
    env: int = 0,
    runs: Sequence[int] = (0,),
    reset_after: int | None = None,
    **options: Any,
) -> Batches:
    """Batches of one or several single collectors, one after the other."""
    batches: Batches = []
    for run in runs:
        collector = Collector(
            make_env(env, num_envs, run=run, env_ids=env_ids),
            make_policy(),
            frames_per_batch=STEPS * (num_envs or 1),
            total_frames=-1,
            **COMMON,
            **options,
        )
        batches += _take(collector, reset_after)
        collector.shutdown()
    return batches


def serial(*, env_ids: bool) -> Batches:
    """Batches of a single collector over several environments that are stepped in turn."""
    env = SerialEnv(ENVS, [partial(make_env, 10 * lane, env_ids=env_ids) for lane in range(ENVS)])
    collector = Collector(env, make_policy(), frames_per_batch=STEPS * ENVS, total_frames=-1, **COMMON)
    batches = _take(collector)
    collector.shutdown()
    return batches


def in_threads(*, env_ids: bool) -> Batches:
    """Flat batches of environments that run in a thread each: their transitions come in any order."""
    collector = AsyncBatchedCollector(
        [partial(make_env, 10 * lane, env_ids=env_ids) for lane in range(ENVS)],
        policy=make_policy(),
        frames_per_batch=STEPS * ENVS,
        backend="threading",
    )
    batches = _take(collector)
    collector.shutdown()
    return batches


def multi(kind: type, *, num_envs: int | None, env_ids: bool, **options: Any) -> Batches:
    """Batches of two workers. Their processes are not ended here."""
    frames = STEPS * (num_envs or 1)
    collector = kind(
        [partial(make_env, 100 * worker, num_envs, env_ids=env_ids) for worker in range(2)],
        make_policy(),
        frames_per_batch=2 * frames if kind is MultiSyncCollector else frames,
        total_frames=-1,
        **COMMON,
        **options,
    )
    return _take(collector)


def _take(collector: Iterable[TensorDictBase], reset_after: int | None = None) -> Batches:
    batches: Batches = []
    for batch in collector:
        batches.append(batch.clone())
        if len(batches) == BATCHES:
            break
        if len(batches) == reset_after:
            collector.reset()  # type: ignore[attr-defined]
    return batches


@dataclass(frozen=True)
class Source:
    """A collector that gives batches.

    Args:
        collect: gives them; it takes ``env_ids``.
        processes: whether it starts worker processes.
    """

    collect: Callable[..., Batches]
    processes: bool = False


def _multi(kind: type, **options: Any) -> Source:
    return Source(partial(multi, kind, **options), processes=True)


SOURCES: dict[str, Source] = {
    "`Collector`, batched environment": Source(partial(single, num_envs=ENVS)),
    "`Collector`, unbatched environment": Source(partial(single, num_envs=None)),
    "`Collector`, `SerialEnv`": Source(serial),
    "`Collector(reset_at_each_iter=True)`, batched": Source(
        partial(single, num_envs=ENVS, reset_at_each_iter=True)
    ),
    "`Collector(reset_at_each_iter=True)`, unbatched": Source(
        partial(single, num_envs=None, reset_at_each_iter=True)
    ),
    "`Collector(set_truncated=True)`, batched": Source(partial(single, num_envs=ENVS, set_truncated=True)),
    "`collector.reset()` in mid-episode, batched": Source(partial(single, num_envs=ENVS, reset_after=3)),
    "`collector.reset()` in mid-episode, unbatched": Source(partial(single, num_envs=None, reset_after=3)),
    "a second `Collector` that uses ids again, batched": Source(partial(single, num_envs=ENVS, runs=(0, 1))),
    "a second `Collector` that uses ids again, unbatched": Source(
        partial(single, num_envs=None, runs=(0, 1))
    ),
    "`Collector(split_trajs=True)`": Source(partial(single, num_envs=ENVS, split_trajs=True)),
    '`Collector(trajs_per_batch=4, traj_format="padded")`': Source(
        partial(single, num_envs=ENVS, trajs_per_batch=4, traj_format="padded")
    ),
    '`Collector(trajs_per_batch=4, traj_format="cat")`': Source(
        partial(single, num_envs=ENVS, trajs_per_batch=4, traj_format="cat")
    ),
    "`Collector(compact_obs=True)`": Source(partial(single, num_envs=ENVS, compact_obs=True)),
    "`Collector(postproc=MultiStep(...))`": Source(
        partial(single, num_envs=ENVS, postproc=MultiStep(gamma=0.9, n_steps=3))
    ),
    "`AsyncBatchedCollector`, environments in threads": Source(in_threads),
    '`MultiSyncCollector(cat_results="stack")`, unbatched': _multi(
        MultiSyncCollector, num_envs=None, cat_results="stack"
    ),
    '`MultiSyncCollector(cat_results="stack")`, batched': _multi(
        MultiSyncCollector, num_envs=ENVS, cat_results="stack"
    ),
    "`MultiSyncCollector(cat_results=0)`, unbatched": _multi(
        MultiSyncCollector, num_envs=None, cat_results=0
    ),
    "`MultiSyncCollector(cat_results=0)`, batched": _multi(MultiSyncCollector, num_envs=ENVS, cat_results=0),
    "`MultiSyncCollector(cat_results=-1)`, unbatched": _multi(
        MultiSyncCollector, num_envs=None, cat_results=-1
    ),
    "`MultiSyncCollector(cat_results=-1)`, batched": _multi(
        MultiSyncCollector, num_envs=ENVS, cat_results=-1
    ),
    "`MultiAsyncCollector`, unbatched": _multi(MultiAsyncCollector, num_envs=None),
    "`MultiAsyncCollector`, batched": _multi(MultiAsyncCollector, num_envs=ENVS),
}
