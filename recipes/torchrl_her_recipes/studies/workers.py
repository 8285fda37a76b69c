"""Makes the workers for the jobs of a study, by the user's options."""

from __future__ import annotations

from importlib.util import find_spec

from torchrl_her_recipes.config.values import load_name
from torchrl_her_recipes.studies.workers_local import LocalWorkers, Workers

_ON_RAY = "torchrl_her_recipes.studies.workers_ray:RayWorkers"


def make_workers(*, jobs: int | None = None, ray: str | None = None, gpus_per_job: float = 0.0) -> Workers:
    """Makes worker processes on this machine, or uses the nodes of a Ray cluster.

    Args:
        jobs: number of jobs at once on this machine; None for one on each core.
        ray: address of a cluster, ``auto`` or ``HOST:PORT``; None for this machine.
        gpus_per_job: the share of a GPU that each job gets on a cluster.

    Raises:
        ImportError: Ray is not installed.
        ValueError: no node of the cluster has this share of a GPU.
        ConnectionError: there is no cluster at the address.
    """
    if ray is None:
        return LocalWorkers(jobs)
    if find_spec("ray") is None:
        raise ImportError("--ray needs Ray: pip install '.[cluster]'")
    workers: Workers = load_name(_ON_RAY)(ray, gpus_per_job=gpus_per_job)
    return workers
