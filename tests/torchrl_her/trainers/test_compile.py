"""Functions that are compiled at their first call."""

from __future__ import annotations

import pytest
import torch

from torchrl_her.trainers import CompiledOnce


def test_what_raises_uncompiled_raises() -> None:
    def broken(x: torch.Tensor) -> torch.Tensor:
        return x + torch.zeros(7)

    with pytest.raises(RuntimeError, match="must match the size"):
        CompiledOnce(broken)(torch.zeros(3))
