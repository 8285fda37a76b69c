"""What all tests share: one thread, a seed, and leaving nothing behind."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest
import torch
from torchrl.envs.utils import exploration_type

# Small tensors are fastest in one thread, and the workers of pytest-xdist share the cores. The second line is
# for the processes that tests start.
torch.set_num_threads(1)
os.environ.setdefault("OMP_NUM_THREADS", "1")


@pytest.fixture(autouse=True)
def _seed() -> Iterator[None]:
    torch.manual_seed(0)
    before = exploration_type()
    yield
    assert exploration_type() is before


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests that take long begin first, so that no worker is left alone with one of them at the end."""
    items.sort(key=lambda item: item.get_closest_marker("long") is None)
