"""Processes on the nodes of a Ray cluster: each row is right, also where a node dies."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from typing import Any

import pytest

pytest.importorskip("ray", exc_type=ImportError)

import ray
from ray._private.node import Node
from ray.cluster_utils import Cluster

from torchrl_her_recipes import Components, build, run
from torchrl_her_recipes.components.collection.cluster import join, resource
from torchrl_her_recipes.config.groups import CollectionConfig

from ...ray_cluster import cluster as cluster
from .collection_program import shown, tagged
from .tagged_task import LENGTH
from .test_processes import ENVS, EPOCHS, FRAMES, audit, audit_run, each_once

pytestmark = [pytest.mark.long, pytest.mark.filterwarnings("ignore::ResourceWarning")]  # Ray's own files


@pytest.fixture
def nodes(cluster: Cluster) -> Iterator[list[Node]]:
    """Two nodes with a core each."""
    own = [cluster.add_node(num_cpus=1) for _ in range(2)]
    join(cluster.address)
    yield own
    for node in list(cluster.worker_nodes):
        cluster.remove_node(node, allow_graceful=False)
    wait_for_cores(0)
    ray.shutdown()


def wait_for_cores(count: int) -> None:
    """Waits until all of a cluster has heard which nodes there are."""
    while resource("CPU") != count:
        time.sleep(0.1)


@pytest.mark.full
@pytest.mark.usefixtures("nodes")
def test_all_rows_are_right_and_a_seed_repeats_them(cluster: Cluster) -> None:
    found, again = (_ran(build(tagged(ray=cluster.address))) for _ in range(2))
    for number, tags in enumerate(audit(found)):
        blocks = [block for reset in found["blocks"] for block in reset[number]]
        assert each_once(tags) == dict.fromkeys(blocks, FRAMES // 2)
    assert found["table"] == again["table"]
    for one, other in zip(found["rows"], again["rows"], strict=True):
        assert (one == other).all()


def _ran(components: Components) -> dict[str, Any]:
    return shown(components, run(components, progress=False))


@pytest.mark.full
@pytest.mark.parametrize("sync", [False, True])
def test_a_node_that_dies_costs_its_open_episodes_alone(
    cluster: Cluster, nodes: list[Node], sync: bool
) -> None:
    components = build(tagged(ray=cluster.address, sync=sync))
    collect, batches = components.collector.next, iter(range(1_000))

    def next_batch() -> Any:
        batch = collect()
        if next(batches) == 3:
            cluster.remove_node(nodes[0], allow_graceful=False)
            wait_for_cores(1)
            if sync:  # otherwise the one that is left would wait for another one
                cluster.add_node(num_cpus=1)
        return batch

    components.collector.next = next_batch  # type: ignore[method-assign]
    with pytest.warns(UserWarning, match="collecting process . died, time 1 in this run"):
        found = _ran(components)
    for rows, waiting in zip(found["rows"], found["held"], strict=True):
        shares = each_once(audit_run(rows))
        assert waiting < ENVS // 2 * LENGTH
        # Rows of the node's open episodes that were sent are there, too: they count as cut.
        assert sum(shares.values()) == EPOCHS * FRAMES - waiting
        assert len(shares) == 2 * EPOCHS + 1 if sync else len(shares) >= EPOCHS


@pytest.mark.full
@pytest.mark.usefixtures("nodes")
def test_too_few_cores_or_an_environment_that_fails_are_one_line(cluster: Cluster) -> None:
    with pytest.raises(ValueError, match="processes=4 need a core each, but 2 of the cluster's 2 are free"):
        build(tagged(ray=cluster.address, processes=4)).collector.next()
    broken = build(tagged(ray=cluster.address, epochs=4, **{"task.options.fails_at": 130}))
    with pytest.raises(RuntimeError, match=r"failed on its node: ValueError: this environment breaks now"):
        run(broken, progress=False)
    absent = build(tagged(ray=cluster.address, **{"task.options.only_in": os.getpid()}))
    with pytest.raises(RuntimeError, match=r"failed on its node: .*there is no display"):
        absent.collector.next()


def test_a_cluster_needs_a_number_of_processes() -> None:
    with pytest.raises(ValueError, match="ray=auto needs the number of processes that collect there"):
        CollectionConfig(ray="auto")
