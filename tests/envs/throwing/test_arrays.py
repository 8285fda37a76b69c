"""Rules on numbers, arrays and tensors alike."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchrl_her_envs.throwing.arrays import within

VALUES = [-3.0, -1.0, 0.25, 1.0, 7.5]


@pytest.mark.parametrize(("dx", "dy", "near"), [(0.0, 0.0, True), (0.3, 0.4, False), (-0.3, 0.39, True)])
def test_within_is_nearer_than_the_distance(dx: float, dy: float, near: bool) -> None:
    assert within(dx, dy, 0.5) is near
    assert within(np.array([dx]), np.array([dy]), 0.5).tolist() == [near]
    assert within(torch.tensor([dx]).double(), torch.tensor([dy]).double(), 0.5).tolist() == [near]
