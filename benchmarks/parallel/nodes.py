"""Collects FetchPush on two nodes of a Ray cluster; one of them dies, and later a new node joins.

    python benchmarks/run.py parallel.nodes

Both nodes are on this machine, so the speed is not that of two machines. The benchmark shows how much is
sent over the network, how many frames are lost with a node, and that the run continues. Needs the extras
`cluster` and `robotics`.
"""

from __future__ import annotations

import argparse
import logging
import os
import time
import warnings
from collections.abc import Sequence
from pathlib import Path

import torch
from machine import describe, publish, table
from ray._private import ray_constants
from ray._private.node import Node
from ray.cluster_utils import Cluster
from tensordict import TensorDict, TensorDictBase

from torchrl_her_recipes import Components, build, make_recipe
from torchrl_her_recipes.components.collection.cluster import join, resource

BATCHES = 30  # number of batches in each phase of the run
PIECES = ("two nodes", "one has died", "another one has come")


def size(entries: TensorDictBase) -> int:
    """Returns the number of bytes that are sent for some entries."""
    return sum(entry.nbytes for entry in entries.values(True, True) if isinstance(entry, torch.Tensor))


def wait_for_cores(count: int) -> None:
    while resource("CPU") != count:
        time.sleep(0.1)


def pieces(cluster: Cluster, nodes: Sequence[Node], components: Components) -> tuple[list[list[str]], str]:
    """Returns a row of the table for each phase of the run, and a text about the amount of sent data."""
    trainer, buffer = components.trainer(), components.buffer
    trainer.run(trainer.warmup_frames)
    rows = []
    for name in PIECES:
        if name == PIECES[1]:
            cluster.remove_node(nodes[0], allow_graceful=False)
            wait_for_cores(1)
        elif name == PIECES[2]:
            cluster.add_node(num_cpus=1)
            wait_for_cores(2)
        frames, began = trainer.frames, time.perf_counter()
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            trainer.run(BATCHES * components.recipe.collection.num_envs)
        seconds = time.perf_counter() - began
        died = sum("died" in str(own.message) for own in caught)
        written = buffer.writer.totals.real
        rows.append(
            [
                name,
                f"{trainer.frames:,}",
                f"{(trainer.frames - frames) / seconds:,.0f}",
                f"{written:,}",
                f"{buffer.writer.held_back:,}",
                str(died),
            ]
        )
    trainer._reset_collector()
    trainer.run(components.recipe.collection.num_envs)
    batch = components.collector.next()
    weights = TensorDict.from_module(components.policy).data
    unwritten = trainer.frames - buffer.writer.totals.real
    sent = (
        f"When all episodes have begun anew, {unwritten:,} frames are not written: those of the episodes "
        f"that are open now. A frame is {size(batch) / batch.numel():,.0f} bytes, the weights of the policy "
        f"are {size(weights) / 1e6:.2f} MB."
    )
    return rows, sent


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path, help="a Markdown file to write the table to, too")
    options = parser.parse_args(arguments)
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    torch.set_num_threads(1)
    ray_constants.ENABLE_RAY_CLUSTER = False  # nodes listen on the loopback interface only
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
    nodes = [cluster.add_node(num_cpus=1) for _ in range(2)]
    join(cluster.address)
    wait_for_cores(2)
    recipe = make_recipe(
        task="gym:FetchPush-v4", algo="filtered_her", processes=2, sync=False, ray=cluster.address
    )
    components = build(recipe)
    try:
        rows, sent = pieces(cluster, nodes, components)
    finally:
        components.close()
    header = ["", "frames", "frames/s", "written", "of open episodes", "processes that died"]
    machine = describe("torch", "torchrl", "ray", "gymnasium-robotics", "mujoco")
    publish(f"{machine}\n\n{table(header, rows)}\n\n{sent}", options.out)


if __name__ == "__main__":
    main()
