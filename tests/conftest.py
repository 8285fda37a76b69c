"""What all tests share: one thread, which small tensors like best, a seed, and leaving nothing behind."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch
from torchrl.envs.utils import exploration_type

torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def _seed() -> Iterator[None]:
    torch.manual_seed(0)
    before = exploration_type()
    yield
    assert exploration_type() is before
