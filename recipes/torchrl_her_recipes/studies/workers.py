"""Makes the workers for the jobs of a study, by the user's options."""

from __future__ import annotations

from importlib import import_module

from torchrl_her_recipes.studies.workers_local import LocalWorkers, Workers


def make_workers(*, jobs: int | None = None, ray: str | None = None, gpus_per_job: float = 0.0) -> Workers:
    """Makes worker processes on this machine, or uses the nodes of a Ray cluster.

    Args:
        jobs: number of jobs at once on this machine; None for one on each core.
        ray: address of a cluster, ``auto`` or ``HOST:PORT``; None for this machine.
        gpus_per_job: the share of a GPU that each job gets on a cluster.

    Raises:
        ImportError: Ray is not installed.
        ValueError: no node of the cluster has so much of a GPU.
        ConnectionError: there is no cluster at the address.
    """
    if ray is None:
        return LocalWorkers(jobs)
    try:
        module = import_module("torchrl_her_recipes.studies.workers_ray")  # needs an extra
    except ModuleNotFoundError as error:
        raise ImportError("--ray needs Ray: pip install '.[cluster]'") from error
    return module.RayWorkers(ray, gpus_per_job=gpus_per_job)
