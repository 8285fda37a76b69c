"""Each collector of TorchRL beside HERWriter and HERSampleUnit: no transition is silently wrong."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest
from tensordict import TensorDictBase

from .audit import Log, Rows
from .collect import SOURCES
from .fill import FILLERS
from .parts import FLAT, PARTS, WRITER, audit, is_writer, make_buffer, shaped
from .program import run_jobs
from .tables import COLLECTORS, name_of, outcome_of

# By what a batch shows which environment a transition is of. All but the last have ids of trajectories.
IDS = ("trajectory ids", "EnvIds", "no ids")
Row = dict[str, tuple[str, ...]]  # for each part, what comes out with each of IDS

_IN_PROCESS = [name for name, source in SOURCES.items() if not source.processes]
_WORKERS = [name for name, source in SOURCES.items() if source.processes]
SHARED = {
    "sync": "`MultiSyncCollector(replay_buffer=...)`",
    "async": "`MultiAsyncCollector(replay_buffer=...)`",
}

# Those that run each time. They have every kind of outcome.
SAMPLE = (
    "`Collector`, batched environment",
    "`Collector`, unbatched environment",
    "`collector.reset()` in mid-episode, batched",
    "a second `Collector` that uses ids again, unbatched",
    '`Collector(trajs_per_batch=4, traj_format="cat")`',
    "`Collector(split_trajs=True)`",
    "`Collector(postproc=MultiStep(...))`",
    "`AsyncBatchedCollector`, environments in threads",
    "`Collector(replay_buffer=..., extend_buffer=False)`, batched",
    "`Collector(replay_buffer=...)` in a thread (`start()`), unbatched",
)
pytestmark = pytest.mark.filterwarnings(
    "ignore:split_trajs=True produces:UserWarning",  # TorchRL's advice
    "ignore:all [0-9]+ episodes have one step:UserWarning",  # steps of threads that take turns: it is so
)


def marked(names: Sequence[str]) -> list[object]:
    """Parameters, those outside of the sample marked as ``full``."""
    return [pytest.param(name, marks=() if name in SAMPLE else pytest.mark.full) for name in names]


def expected(name: str) -> Row:
    """What the table says of a collector."""
    cells = zip(PARTS, COLLECTORS[name], strict=True)
    return {part: (cell,) * 3 if isinstance(cell, str) else cell for part, cell in cells}


# TorchRL itself, in AsyncBatchedCollector.
@pytest.mark.filterwarnings("ignore:The int written over the NonTensorData entry 'env_index':FutureWarning")
@pytest.mark.parametrize("name", marked(_IN_PROCESS))
def test_batches_are_written_rightly_or_refused(name: str) -> None:
    collect = SOURCES[name].collect
    assert outcomes_of_batches(collect(env_ids=False), collect(env_ids=True)) == expected(name)


@pytest.mark.parametrize("name", marked(list(FILLERS)))
def test_what_a_collector_writes_by_itself_is_right_or_refused(name: str) -> None:
    assert outcomes_of_filler(name) == expected(name)


@pytest.mark.long
def test_a_sample_with_worker_processes_is_right_or_refused() -> None:
    name = "`MultiSyncCollector(cat_results=-1)`, batched"
    collect = [("collect", name, env_ids) for env_ids in (False, True)]
    share = [("share", "sync", part) for part in (WRITER, FLAT)]
    (plain, said), (with_env_ids, said_too), *shared = run_jobs([*collect, *share])
    _check_batches(name, plain, said, with_env_ids, said_too)
    for job, (result, said) in zip(share, shared, strict=True):
        _check_shared(*job[1:], result, said)


@pytest.mark.full
@pytest.mark.long
def test_batches_of_worker_processes_are_written_rightly_or_refused() -> None:
    jobs = [("collect", name, env_ids) for name in _WORKERS for env_ids in (False, True)]
    results = iter(run_jobs(jobs))
    for name in _WORKERS:
        _check_batches(name, *next(results), *next(results))


@pytest.mark.full
@pytest.mark.long
@pytest.mark.parametrize("start", ["fork", "spawn"])
def test_workers_do_not_write_to_a_shared_buffer(start: str) -> None:
    parts = PARTS if start == "fork" else (WRITER, FLAT)  # what is spawned takes ten times as long
    jobs = [("share", kind, part) for kind in SHARED for part in parts]
    for job, (result, said) in zip(jobs, run_jobs(jobs, start=start), strict=True):
        _check_shared(*job[1:], result, said)


def _check_batches(name: str, plain: Any, said: str, with_env_ids: Any, said_too: str) -> None:
    assert plain is not None, said
    assert with_env_ids is not None, said_too
    assert outcomes_of_batches(plain, with_env_ids) == expected(name), name


def _check_shared(kind: str, part: str, result: Any, said: str) -> None:
    assert result is None, f"{kind}, {part}: was not refused"
    assert (name_of(said),) * 3 == expected(SHARED[kind])[part]


def outcomes_of_batches(plain: Sequence[TensorDictBase], with_env_ids: Sequence[TensorDictBase]) -> Row:
    """What happens when a learner extends its buffer with a collector's batches.

    Args:
        plain, with_env_ids: collected without and with the transform EnvIds.
    """
    bare = [batch.exclude(("collector", "traj_ids")) for batch in plain]
    return {
        part: tuple(
            outcome_of(lambda: _extend(part, batches))  # noqa: B023
            for batches in (plain, with_env_ids, bare)
        )
        for part in PARTS
    }


def outcomes_of_filler(name: str) -> Row:
    """What happens when a collector writes to a buffer by itself."""
    return {part: tuple(outcome_of(lambda: _fill(name, part, ids)) for ids in IDS) for part in PARTS}  # noqa: B023


def _extend(part: str, batches: Sequence[TensorDictBase]) -> None:
    buffer = make_buffer(part)
    try:
        for batch in batches:
            buffer.extend(shaped(part, batch))
            if len(buffer) > 0:
                buffer.sample()
    except Exception:
        _audit_refused(part, buffer, batches)
        raise
    audit(part, buffer, Log(batches))


def _audit_refused(part: str, buffer: Any, batches: Sequence[TensorDictBase]) -> None:
    """What was written before a refusal must be right, too."""
    if is_writer(part) and len(buffer) > 0:
        Rows(buffer.storage[:], Log(batches))


def _fill(name: str, part: str, ids: str) -> None:
    buffer = make_buffer(part)
    done = FILLERS[name](buffer, env_ids=ids == "EnvIds", track_traj_ids=ids != "no ids")
    audit(part, buffer, Log(done))


def test_the_table_has_each_collector() -> None:
    assert list(COLLECTORS) == [*SOURCES, *FILLERS, *SHARED.values()]
