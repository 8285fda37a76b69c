"""A Ray cluster on this machine, for tests."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

pytest.importorskip("ray", exc_type=ImportError)

from ray._private import ray_constants
from ray.cluster_utils import Cluster


@pytest.fixture(scope="module")
def cluster() -> Iterator[Cluster]:
    """A head that does no work."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ray_constants, "ENABLE_RAY_CLUSTER", False)  # it then listens on the loopback alone
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
        yield cluster
        cluster.shutdown()
