"""Studies over a Ray cluster: two nodes on this machine, one of which dies."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from torchrl_her_recipes.config.study import Study
from torchrl_her_recipes.studies.jobs import can_resume, read_progress
from torchrl_her_recipes.studies.study import StudyResult, run_study

from ..small import SMALL

pytest.importorskip("ray", exc_type=ImportError)

import ray
from ray._private.node import Node
from ray.cluster_utils import Cluster

from torchrl_her_recipes.studies.workers_ray import RayWorkers

from ..ray_cluster import cluster as cluster

pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning")  # Ray's own files and processes
ALGORITHMS = ("her", "filtered_her")
LABELS = [f"{name}/seeds_0" for name in ALGORITHMS]


@pytest.fixture
def node(cluster: Cluster) -> Iterator[Node]:
    """A node with one core."""
    yield cluster.add_node(num_cpus=1)
    for node in list(cluster.worker_nodes):
        cluster.remove_node(node, allow_graceful=False)


def study(**recipe: Any) -> Study:
    common = {**SMALL, "task": "hand_v0", "compile": "never", **recipe}
    return Study(name="small", recipe=common, vary={"algo": ALGORITHMS})


@pytest.mark.full
@pytest.mark.long
def test_a_node_that_dies_loses_only_its_run_which_is_done_again(
    tmp_path: Path, cluster: Cluster, node: Node
) -> None:
    workers, epochs = RayWorkers(cluster.address), 14
    with ThreadPoolExecutor(1) as threads:
        result = threads.submit(run_study, study(epochs=epochs), tmp_path, workers=workers, progress=False)
        while not (first := list(tmp_path.glob("*/*/metrics.csv"))) or not under_way(workers):
            assert not result.done()
            time.sleep(0.1)
        written = [path.stat().st_mtime_ns for path in first]
        cluster.remove_node(node, allow_graceful=False)
        cluster.add_node(num_cpus=1)
        done = result.result()
    assert (done.figure, done.interrupted, done.failed) == (tmp_path / "small.png", False, {})
    assert sorted(done.successes) == sorted(ALGORITHMS)
    assert [path.stat().st_mtime_ns for path in first] == written
    for label in LABELS:
        assert read_progress(tmp_path / label).epochs == epochs
        assert (tmp_path / label / "policy.safetensors").exists()
        assert not can_resume(tmp_path / label)  # buffers of what is done stay where they were
    assert sorted(path.name for path in tmp_path.iterdir()) == [".lock", *sorted(ALGORITHMS), "small.png"]


@pytest.mark.full
@pytest.mark.long
@pytest.mark.usefixtures("node")
def test_ctrl_c_brings_home_what_there_is(tmp_path: Path, cluster: Cluster) -> None:
    workers = RayWorkers(cluster.address)

    def press() -> None:
        while not under_way(workers):
            time.sleep(0.1)
        os.kill(os.getpid(), signal.SIGINT)

    with ThreadPoolExecutor(1) as threads:
        threads.submit(press)
        result = run_study(study(epochs=10_000), tmp_path, workers=workers, progress=False)
    assert result == StudyResult(figure=None, interrupted=True)
    (label,) = (label for label in LABELS if can_resume(tmp_path / label))  # there was one core
    assert read_progress(tmp_path / label).epochs > 0


def under_way(workers: RayWorkers) -> bool:
    """Whether a run has evaluated for the first time."""
    return any(progress.epochs for progress in workers.progress().values())


def test_each_job_gets_its_share_of_a_gpu(cluster: Cluster) -> None:
    node = cluster.add_node(num_cpus=6, num_gpus=1)  # Ray takes a node's word for it
    try:
        workers = RayWorkers(cluster.address, gpus_per_job=0.25)
        assert workers.at_once == 4
        workers.close()
        with pytest.raises(ValueError, match="no node of the cluster has gpus_per_job=2 GPUs"):
            RayWorkers(cluster.address, gpus_per_job=2)
        with pytest.raises(ValueError, match=r"gpus_per_job must be at most 1 or a whole number, got 1\.5"):
            RayWorkers(cluster.address, gpus_per_job=1.5)
    finally:
        ray.shutdown()
        cluster.remove_node(node, allow_graceful=False)


def test_no_cluster_is_one_clear_line() -> None:
    with pytest.raises(ConnectionError, match="cannot connect to a Ray cluster at 127.0.0.1:1: .*refused"):
        RayWorkers("127.0.0.1:1")
