"""Forward kinematics against positions worked out on paper."""

import math

import pytest
import torch

from torchrl_her_envs.throwing.kinematics import chain

RIGHT, UP, DOWN = 0.0, math.pi / 2, -math.pi / 2


@pytest.mark.parametrize(
    ("angles", "expected"),
    [
        ([RIGHT], [[0, 0], [6, 0]]),
        ([UP], [[0, 0], [0, 6]]),
        ([math.pi / 6], [[0, 0], [3 * math.sqrt(3), 3]]),
        ([RIGHT, UP], [[0, 0], [3, 0], [3, 3]]),
        ([UP, UP], [[0, 0], [0, 3], [-3, 3]]),  # the second is counted from the first: it points left
        ([UP, math.pi], [[0, 0], [0, 3], [0, 0]]),  # folded
        ([UP, DOWN, DOWN], [[0, 0], [0, 2], [2, 2], [2, 0]]),
        ([math.pi, 0.0, 0.0], [[0, 0], [-2, 0], [-4, 0], [-6, 0]]),
    ],
)
def test_positions(angles: list[float], expected: list[list[float]]) -> None:
    points = chain(torch.tensor(angles, dtype=torch.float64), torch.zeros(2, dtype=torch.float64), 6.0)
    torch.testing.assert_close(points, torch.tensor(expected, dtype=torch.float64), rtol=0, atol=1e-12)


def test_base_moves_every_point() -> None:
    points = chain(torch.tensor([RIGHT, UP]), torch.tensor([1.0, -2.0]), 2.0)
    torch.testing.assert_close(points, torch.tensor([[1.0, -2.0], [2.0, -2.0], [2.0, -1.0]]))


def test_any_batch_shape_equals_single_chains() -> None:
    angles = torch.rand(4, 5, 3, generator=torch.Generator().manual_seed(0)) * 7 - 3
    base = torch.tensor([0.5, 0.25])
    points = chain(angles, base, 2.0)
    assert points.shape == (4, 5, 4, 2)
    for i in range(4):
        for j in range(5):
            torch.testing.assert_close(points[i, j], chain(angles[i, j], base, 2.0))


@pytest.mark.parametrize("links", [1, 2, 3, 7])
def test_links_are_equally_long(links: int) -> None:
    angles = torch.rand(50, links, dtype=torch.float64, generator=torch.Generator().manual_seed(links)) * 7
    lengths = chain(angles, torch.zeros(2, dtype=torch.float64), 2.0).diff(dim=-2).norm(dim=-1)
    torch.testing.assert_close(lengths, torch.full((50, links), 2.0 / links, dtype=torch.float64))
