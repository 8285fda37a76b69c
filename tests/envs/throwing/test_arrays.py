"""Rules on numbers, arrays and tensors alike."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from torchrl_her_envs.throwing.arrays import confined, functions_of, like, within

VALUES = [-3.0, -1.0, 0.25, 1.0, 7.5]


def test_functions_are_those_of_the_values() -> None:
    assert functions_of(np.zeros(1)) is np
    assert functions_of(torch.zeros(1)) is torch
    assert functions_of(0.5).cos(0.0) == 1.0
    assert functions_of(np.float64(0.5)).sin is math.sin  # it is a float


def test_constants_become_like_the_values() -> None:
    constant = np.array([0.5, 2.0])
    assert like(constant, np.zeros(2, np.float32)) is constant
    assert like(constant, torch.zeros(2)).dtype == torch.float32


def test_confined_numbers_arrays_and_tensors_agree() -> None:
    expected = [-1.0, -1.0, 0.25, 1.0, 1.0]
    assert [confined(value, -1.0, 1.0) for value in VALUES] == expected
    assert confined(np.array(VALUES), -1.0, 1.0).tolist() == expected
    ends = torch.tensor(-1.0), torch.tensor(1.0)
    assert confined(torch.tensor(VALUES), *ends).tolist() == expected


@pytest.mark.parametrize(("dx", "dy", "near"), [(0.0, 0.0, True), (0.3, 0.4, False), (-0.3, 0.39, True)])
def test_within_is_nearer_than_the_distance(dx: float, dy: float, near: bool) -> None:
    assert within(dx, dy, 0.5) is near
    assert within(np.array([dx]), np.array([dy]), 0.5).tolist() == [near]
    assert within(torch.tensor([dx]).double(), torch.tensor([dy]).double(), 0.5).tolist() == [near]
