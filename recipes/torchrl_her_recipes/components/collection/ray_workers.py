"""Collects with processes on the nodes of a Ray cluster. Needs the extra `cluster`."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Sequence

import ray
import torch
from ray.exceptions import ObjectLostError, OutOfMemoryError, RayActorError, RayError
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors.distributed import RayCollector
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType

from torchrl_her_recipes.components.collection.cluster import join, one_line, resource
from torchrl_her_recipes.components.collection.worker import Beginning, NodeCollector

_SECONDS = 1.0  # seconds between two checks that the cluster still has nodes
_DEATHS = 3  # largest number of deaths of a process between two of its batches; one more ends the run
_ON_A_CORE = {"num_cpus": 1, "num_gpus": 0, "scheduling_strategy": "SPREAD"}


class NodeWorkers(RayCollector):
    """Collector with processes on the nodes of a Ray cluster, which receive weights and return batches.

    Each process uses one core. The nodes need only this package. If a node dies, each of its processes is
    replaced by a new process on another node, as soon as a core is free, which begins new episodes. The
    unfinished batch of a lost process is dropped. The steps of its open episodes that it sent earlier are
    kept, and stored when open episodes are ended (at each epoch of a :class:`~torchrl_her.Trainer`).

    Args:
        address: address of the cluster, HOST:PORT, or ``auto`` for the cluster of this machine.
        make_env: function that makes the environments of a process.
        policy: a copy of the policy, on the CPU.

    Keyword Args:
        processes: N, the number of processes.
        frames: number of frames in a batch of one process.
        sync: True if each batch [N, ...] is from all processes; False if it is from the first that is ready.

    Raises:
        ConnectionError: there is no such cluster.
        ValueError: fewer than N cores of the cluster are free.
        RuntimeError: a process raised an error, or died repeatedly without sending a batch.
    """

    def __init__(
        self,
        address: str,
        make_env: Callable[[], EnvBase],
        policy: TensorDictModuleBase,
        *,
        processes: int,
        frames: int,
        sync: bool,
    ) -> None:
        join(address)
        free, cores = (
            int(resources.get("CPU", 0)) for resources in (ray.available_resources(), ray.cluster_resources())
        )
        if free < processes:
            raise ValueError(
                f"processes={processes} need a core each, but {free} of the cluster's {cores} are free"
            )
        self._orders: dict[int, ray.ObjectRef] = {}  # for each process, the batch that it is collecting
        self._beginnings: list[Beginning] = []
        self._to_begin: set[int] = set()  # processes whose next batch must begin with new episodes
        self._lives = [1] * processes
        self._deaths = [0] * processes  # number of deaths of each process since its last batch
        self._make_env = make_env
        try:
            super().__init__(
                [make_env] * processes,
                policy,
                frames_per_batch=frames * (processes if sync else 1),
                device=torch.device("cpu"),
                collector_class=NodeCollector,
                collector_kwargs={"auto_register_policy_transforms": False},
                exploration_type=ExplorationType.RANDOM,
                remote_configs=_ON_A_CORE,
                sync=sync,
                weight_sync_schemes={},  # TorchRL's schemes would wait for a node that has died
            )
        except RayError as error:
            raise RuntimeError(f"a process that collects cannot start: {one_line(error)}") from error

    def begin(self, beginnings: Sequence[Beginning]) -> None:
        """Drops the batches that processes are collecting, and begins new episodes in all processes."""
        self._orders.clear()
        self._beginnings, self._to_begin = list(beginnings), set(range(len(beginnings)))

    def ahead(self, weights: TensorDictBase) -> None:
        """Starts collecting the next batch with these weights in all idle processes."""
        self._order(weights, range(self.num_collectors))

    def take(self, weights: TensorDictBase) -> TensorDictBase:
        """Returns the next batch: [N, ...] from all processes or, without sync, from the first one ready."""
        batches: dict[int, TensorDictBase] = {}
        while len(batches) < (self.num_collectors if self._sync else 1):
            self._order(weights, set(range(self.num_collectors)) - set(batches))
            ready, _ = ray.wait(
                list(self._orders.values()), timeout=_SECONDS
            )  # if several are ready, returns the one that was started first
            if not ready and resource("CPU") == 0:
                raise RuntimeError("no node that could collect is left in the cluster")
            for process in [index for index, order in self._orders.items() if order in ready]:
                batch = self._fetch(process)
                if batch is not None:
                    batches[process] = batch
        if self._sync:
            return torch.stack([batches[process] for process in range(self.num_collectors)])
        return next(iter(batches.values()))

    def _order(self, weights: TensorDictBase, processes: Iterable[int]) -> None:
        """Starts collecting a batch in those of the given processes that are idle."""
        idle = [process for process in processes if process not in self._orders]
        if not idle:
            return
        sent = ray.put(weights)
        for process in idle:
            beginning = self._beginnings[process] if process in self._to_begin else None
            collector = self.remote_collectors[process]
            self._orders[process] = collector.collect.remote(sent, beginning)
            self._to_begin.discard(process)

    def _fetch(self, process: int) -> TensorDictBase | None:
        """Returns the batch that a process has collected; None if the process died and was replaced."""
        order = self._orders.pop(process)
        try:
            batch = ray.get(order)
        except (RayActorError, ObjectLostError, OutOfMemoryError) as error:
            self._deaths[process] += 1
            if self._deaths[process] > _DEATHS:
                raise RuntimeError(
                    f"collecting process {process} died {_DEATHS + 1} times without sending a "
                    f"batch: {one_line(error)}"
                ) from error
            warnings.warn(
                f"collecting process {process} died, time {self._lives[process]} in this run: its unfinished "
                "batch is lost, and a new process replaces it",
                stacklevel=2,
            )
            self._replace(process)
            return None
        except RayError as error:
            raise RuntimeError(f"a process that collects failed: {one_line(error)}") from error
        if isinstance(batch, str):
            raise RuntimeError(f"a process that collects failed on its node: {batch}")
        self._deaths[process] = 0
        return batch

    def _replace(self, process: int) -> None:
        self.add_collectors([self._make_env], 1, self.policy, [self.collector_kwargs[process]], [_ON_A_CORE])
        self.remote_collectors[process] = self.remote_collectors.pop()
        self._beginnings[process] = self._beginnings[process].again(self._lives[process])
        self._lives[process] += 1
        self._to_begin.add(process)
