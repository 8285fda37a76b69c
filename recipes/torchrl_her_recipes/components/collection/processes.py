"""Collects experience in separate processes, on this machine or on a cluster, while the main one learns."""

from __future__ import annotations

import ast
import multiprocessing
import signal
import sys
import weakref
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from copy import deepcopy
from functools import partial
from importlib.util import find_spec
from multiprocessing.process import BaseProcess
from multiprocessing.util import Finalize
from pathlib import Path
from queue import Empty
from typing import TYPE_CHECKING, Any, TypeAlias

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import BaseCollector, MultiAsyncCollector, MultiSyncCollector
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType
from torchrl.weight_update import SharedMemWeightSyncScheme

from torchrl_her.curriculum.stages import CurriculumProgress
from torchrl_her_recipes.components.collection.worker import (
    Beginning,
    WorkerCollector,
    begin_process,
    derive_seed,
    drawing_modules,
    share_of_envs,
)
from torchrl_her_recipes.components.devices import CPU
from torchrl_her_recipes.config.groups import CollectionConfig
from torchrl_her_recipes.config.imports import imported_modules
from torchrl_her_recipes.config.values import load_name

if TYPE_CHECKING:
    from torchrl_her_recipes.components.collection.ray_workers import NodeWorkers

_ON_RAY = "torchrl_her_recipes.components.collection.ray_workers:NodeWorkers"
_SECONDS = 1.0  # seconds between two checks that all processes are alive
_FAILED = "a process failed: worker {} (exit code {})"
_TRACEBACK = "Worker traceback:"  # TorchRL's message repeats ``__cause__`` after these words
_EXIT_PRIORITY = 100  # high enough to end the processes before multiprocessing waits for them at exit


class CheckedWeightSync(SharedMemWeightSyncScheme):
    """Sends weights in shared memory; raises an error, instead of hanging, if a process has ended."""

    def _wait_for_ack(self, worker_ids: object = None, timeout: float | None = None) -> None:
        for queue in self._ack_queues.values():
            _get(queue.get, self.context.procs)


class SyncWorkers(MultiSyncCollector):
    """Collector whose processes collect each batch together; row k always belongs to the same environment."""

    def __init__(self, *args: Any, **options: Any) -> None:
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="collection")  # thread that waits for batches
        self._batch: Future[TensorDictBase] | None = None  # the batch that is being collected
        super().__init__(*args, cat_results="stack", **options)

    def begin(self, beginnings: Sequence[Beginning]) -> None:
        """Drops the batch that is being collected, if any, and begins new episodes in all processes."""
        if self._batch is not None:
            self._batch.result()
            self._batch = None
        self.map_fn("begin", [(beginning,) for beginning in beginnings])

    def ahead(self, weights: TensorDictBase) -> None:
        """Starts collecting the next batch with these weights of the policy, if it was not started before."""
        if self._batch is None:
            self.update_policy_weights_(weights)  # now, while no process reads the shared weights
            self._batch = self._thread.submit(self.next)

    def take(self, weights: TensorDictBase) -> TensorDictBase:
        """Returns the next batch: [processes, environments, T], or [environments, T] of a single process."""
        self.ahead(weights)
        assert self._batch is not None
        batch = self._batch.result()
        self._batch = None
        return batch

    def _shutdown_main(self, timeout: float | None = None) -> None:
        super()._shutdown_main(timeout)
        self._thread.shutdown(wait=False)  # without waiting: this may run in that thread itself


class AsyncWorkers(MultiAsyncCollector):
    """Collector whose processes collect batches independently; finished batches wait in a queue."""

    running: bool  # whether processes are collecting; declared since TorchRL gives it no type

    @property
    def _queue_len(self) -> int:
        return self.num_workers  # TorchRL's default is 1, but a process drops its batch if the queue is full

    def begin(self, beginnings: Sequence[Beginning]) -> None:
        if self.running:  # discard old batches, which would else be returned after the reset
            for _ in range(self.num_workers):
                _get(self._get_from_queue, self.procs)
            self.running, self._iterator = False, None
        self.map_fn("begin", [(beginning,) for beginning in beginnings])

    def ahead(self, weights: TensorDictBase) -> None:
        """Does nothing: the processes collect all the time."""

    def take(self, weights: TensorDictBase) -> TensorDictBase:
        self.update_policy_weights_(weights)
        return self.next()


Workers: TypeAlias = "SyncWorkers | AsyncWorkers | NodeWorkers"


class ProcessCollector(BaseCollector):
    """Collects in N processes, each of which has E / N of the E environments of each of R runs.

    The processes start when the first batch is requested. :meth:`shutdown` ends them; the next request for a
    batch starts them again.

    With ``sync=true`` all processes collect a batch [R * E, T] together, where row k always belongs to the
    same environment. After :meth:`collect_ahead` they collect the next batch while the caller learns from
    the last one. The policy that acts in such a batch is always one batch old, and the same seed gives the
    same batches. With ``sync=false`` no process waits for another: a batch [R * E / N, T] comes from the
    process that finishes first, and each row has the id of its environment.

    With ``ray=ADDRESS`` the processes run on the nodes of a Ray cluster, see
    :class:`~torchrl_her_recipes.components.collection.ray_workers.NodeWorkers`.

    The random numbers of a process depend only on the seeds of the runs, the index of the process and the
    number of resets.

    Args:
        options: Options of collection.
        make_env: Function that makes the environments of a process. Its argument ``modules`` has the names of
            modules to import first.
        policy: Policy whose weights and epsilon are sent to the processes.
        seeds: Seeds of the runs.
        progress: Stages of the runs, which are sent with each reset; None without a curriculum.
        storing_device: Device to which batches are moved. The processes use the CPU.

    Raises:
        RuntimeError: A process failed while collecting a batch.
    """

    def __init__(
        self,
        options: CollectionConfig,
        make_env: Callable[..., EnvBase],
        policy: TensorDictModuleBase,
        *,
        seeds: Sequence[int],
        progress: CurriculumProgress | None = None,
        storing_device: torch.device = CPU,
    ) -> None:
        super().__init__()
        self.options, self.make_env, self.policy = options, make_env, policy
        self.seeds, self.progress, self.storing_device = seeds, progress, storing_device
        self.requested_frames_per_batch = len(seeds) * options.num_envs * options.steps_per_batch
        self.total_frames = -1
        self.resets = 0
        self._workers: Workers | None = None

    def next(self) -> TensorDictBase:
        """Returns the next batch; if the processes are not running, starts them with new episodes."""
        if self._workers is None:
            self.reset()
        assert self._workers is not None
        with self._ended_by_errors():
            batch = _in_blocks(self._workers.take(self._weights()), len(self.seeds))
        return batch if self.storing_device == CPU else batch.to(self.storing_device)

    def collect_ahead(self) -> None:
        """Starts collecting the next batch with the current weights of the policy, without waiting for it."""
        if self._workers is not None:
            with self._ended_by_errors():
                self._workers.ahead(self._weights())

    def reset(self, index: object = None, **kwargs: object) -> None:
        """Begins new episodes in all environments, and drops the batches that are being collected."""
        with self._ended_by_errors():
            if self._workers is None:
                self._workers = self._start()
            self.resets += 1
            self._workers.begin([self._beginning(process) for process in range(self.options.processes)])

    def shutdown(
        self, timeout: float | None = None, close_env: bool = True, raise_on_error: bool = True
    ) -> None:
        """Ends the processes, if there are any."""
        workers, self._workers = self._workers, None
        if workers is not None:
            _end(workers)

    def iterator(self) -> Iterator[TensorDictBase]:
        while True:
            yield self.next()

    def set_seed(self, seed: int, static_seed: bool = False) -> int:
        """Raises an error: the recipe's seed determines all random numbers."""
        raise NotImplementedError("collecting processes take their seeds from the recipe: set its seed")

    def state_dict(self) -> OrderedDict:
        """Returns the number of resets, which with the seeds determines all later random numbers."""
        return OrderedDict(resets=self.resets)

    def load_state_dict(self, state_dict: OrderedDict) -> None:
        self.resets = state_dict["resets"]

    def _start(self) -> Workers:
        """Starts the processes. This takes seconds, since each process imports torch."""
        config = self.options
        make = partial(self.make_env, modules=imported_modules())
        frames = len(self.seeds) * share_of_envs(config) * config.steps_per_batch
        if config.ray is not None:
            if find_spec("ray") is None:
                raise ImportError(f"ray={config.ray} needs Ray: pip install '.[cluster]'")
            start = partial(load_name(_ON_RAY), config.ray, make, _to_send(self.policy), frames=frames)
            return start(processes=config.processes, sync=config.sync)
        _check_main_script(f"processes={config.processes}")
        kind = SyncWorkers if config.sync else AsyncWorkers
        with _interrupts_later():  # else Ctrl-C during the start prints a traceback for each process
            workers = kind(
                [make] * config.processes,
                _to_send(self.policy),
                frames_per_batch=frames * (config.processes if config.sync else 1),
                total_frames=-1,
                device="cpu",  # device of environments, policy and storage
                collector_class=WorkerCollector,
                exploration_type=ExplorationType.RANDOM,
                num_threads=torch.get_num_threads(),  # TorchRL sets this number in the main process
                num_sub_threads=1,
                weight_sync_schemes={"policy": CheckedWeightSync()},
                init_fn=begin_process,
                auto_register_policy_transforms=False,
            )
        Finalize(workers, _end_if_there, args=(weakref.ref(workers),), exitpriority=_EXIT_PRIORITY)
        return workers

    def _beginning(self, process: int) -> Beginning:
        def seeds(kind: int) -> list[int]:
            return [derive_seed(seed, process, self.resets, kind) for seed in self.seeds]

        return Beginning(
            env_seeds=seeds(0),
            seeds=seeds(1),
            progress=None if self.progress is None else self.progress.state_dict(),
        )

    def _weights(self) -> TensorDictBase:
        return TensorDict.from_module(self.policy).data.to(CPU)

    @contextmanager
    def _ended_by_errors(self) -> Iterator[None]:
        """Context manager that ends all processes if the block raises an error, and explains the error."""
        try:
            yield
        except Exception as error:
            self.shutdown()
            reason, traceback, _ = str(error).partition(_TRACEBACK)
            if traceback:  # TorchRL adds a traceback only if a process could not start
                raise RuntimeError(f"a process that collects cannot start: {reason.strip()}") from error
            if isinstance(error, RuntimeError) and "process failed" in reason:
                raise RuntimeError(
                    "a process that collects has failed, and all others were ended; the error of the process "
                    f"is printed above: {error}"
                ) from error
            raise


def _check_main_script(asked: str) -> None:
    """Raises an error if the main script has no ``__name__`` guard: processes import it, and would train."""
    path = getattr(sys.modules["__main__"], "__file__", None)
    if path is None or multiprocessing.get_start_method(allow_none=True) == "fork":
        return
    guards = (node.test for node in ast.parse(Path(path).read_bytes()).body if isinstance(node, ast.If))
    if not any("__name__" in ast.unparse(guard) for guard in guards):
        raise RuntimeError(
            f"{asked} starts processes that import {path}: put the code that trains under "
            "`if __name__ == '__main__':`"
        )


def _get(get: Callable[..., Any], processes: Sequence[BaseProcess]) -> Any:
    """Waits for the next item of a queue that processes write to, as long as all the processes are alive.

    Raises:
        RuntimeError: one of the processes has ended.
    """
    while True:
        try:
            return get(timeout=_SECONDS)
        except Empty:
            for number, process in enumerate(processes):
                if not process.is_alive():
                    raise RuntimeError(_FAILED.format(number, process.exitcode)) from None


def _in_blocks(batch: TensorDictBase, runs: int) -> TensorDictBase:
    """Reorders a batch of several processes, so that the environments of each run are together: [R * E, T].

    Args:
        batch: [N, R * E / N, T] from N processes, or the batch of a single process, which is in order.
        runs: R.
    """
    batch.names = None
    if batch.ndim == 2:
        return batch
    if runs > 1:
        batch = batch.unflatten(1, (runs, batch.shape[1] // runs)).transpose(0, 1).flatten(0, 1)
    return batch.flatten(0, 1)


def _to_send(policy: TensorDictModuleBase) -> TensorDictModuleBase:
    """Returns a copy of a policy on the CPU, which can be sent to other processes.

    The copy has no random generators: each process makes its own, and several generators cannot be sent to
    another process.
    """
    copy = deepcopy(policy).to(CPU)
    for module in drawing_modules(copy):
        module.generators = [None] * len(module.generators)
    return copy


def _end(workers: Workers) -> None:
    threads = torch.get_num_threads()
    try:
        workers.shutdown()
    finally:
        torch.set_num_threads(threads)  # TorchRL changes the number of threads when it ends its processes


def _end_if_there(workers: weakref.ref[Any]) -> None:
    if (alive := workers()) is not None:
        _end(alive)


@contextmanager
def _interrupts_later() -> Iterator[None]:
    """Context manager that delays Ctrl-C until its end; processes started in the block ignore Ctrl-C."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
