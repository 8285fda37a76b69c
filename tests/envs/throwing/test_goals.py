"""Distributions of goals: boxes and sectors."""

import numpy as np
import pytest
import torch

from torchrl_her_envs import BoxGoals, GoalDistribution, SectorGoals

BOX = BoxGoals((0.0, -1.0), (2.0, 3.0))
SECTOR = SectorGoals((1.0, 2.0), angle=(75.0, 105.0), radius=(0.75, 1.0))


def close(a: torch.Tensor, b: list[float]) -> None:
    torch.testing.assert_close(a, torch.tensor(b, dtype=torch.float64), rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("goals", "u", "point"),
    [
        (BOX, [0.0, 0.0], [0.0, -1.0]),
        (BOX, [1.0, 1.0], [2.0, 3.0]),
        (BOX, [0.25, 0.5], [0.5, 1.0]),
        (SECTOR, [0.5, 0.0], [1.0, 2.75]),  # 90 degrees: straight above the center
        (SECTOR, [0.5, 1.0], [1.0, 3.0]),
        (SECTOR, [0.0, 1.0], [1.2588190451025207, 2.9659258262890684]),  # cos 75 and sin 75 degrees
        (SECTOR, [1.0, 1.0], [0.7411809548974793, 2.9659258262890684]),
    ],
)
def test_points(goals: GoalDistribution, u: list[float], point: list[float]) -> None:
    close(goals.from_uniform(torch.tensor(u, dtype=torch.float64)), point)


@pytest.mark.parametrize(
    ("angle", "low", "high"),
    [
        ((75.0, 105.0), [-0.2588190451025207, 0.7244443697168011], [0.2588190451025207, 1.0]),
        ((0.0, 90.0), [0.0, 0.0], [1.0, 1.0]),
        ((30.0, 200.0), [-1.0, -0.3420201433256687], [0.8660254037844387, 1.0]),
        ((-10.0, 10.0), [0.7386058148, -0.1736481777], [1.0, 0.1736481777]),
        ((0.0, 360.0), [-1.0, -1.0], [1.0, 1.0]),
    ],
)
def test_box_around_a_sector(angle: tuple[float, float], low: list[float], high: list[float]) -> None:
    sector = SectorGoals((0.0, 0.0), angle=angle, radius=(0.75, 1.0))
    assert not sector.is_box
    torch.testing.assert_close(sector.low, torch.tensor(low, dtype=torch.float64), rtol=0, atol=1e-9)
    torch.testing.assert_close(sector.high, torch.tensor(high, dtype=torch.float64), rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    "goals", [BOX, SECTOR, SectorGoals((0.0, 0.0), angle=(10.0, 123.0), radius=(1.0, 2.0))]
)
def test_samples_fill_the_box_around_them(goals: GoalDistribution) -> None:
    points = goals.sample(20_000, generator=torch.Generator().manual_seed(0))
    assert points.shape == (20_000, 2)
    assert points.dtype == torch.float64
    assert (points >= goals.low - 1e-12).all()
    assert (points <= goals.high + 1e-12).all()
    room = 0.02 * (goals.high - goals.low)
    assert (points.amin(0) <= goals.low + room).all()
    assert (points.amax(0) >= goals.high - room).all()


def test_sector_is_uniform_in_angle_and_radius() -> None:
    offset = SECTOR.sample(20_000, generator=torch.Generator().manual_seed(0)) - SECTOR.center
    radius, angle = offset.norm(dim=-1), torch.rad2deg(torch.atan2(offset[:, 1], offset[:, 0]))
    for value, low, high in ((radius, 0.75, 1.0), (angle, 75.0, 105.0)):
        assert low - 1e-9 <= value.min()
        assert value.max() <= high + 1e-9
        quarters = torch.histc(value, bins=4, min=low, max=high)
        assert (quarters - 5000).abs().max() < 300  # five standard deviations of a binomial count


@pytest.mark.parametrize("goals", [BOX, SECTOR])
def test_a_generator_makes_samples_repeat(goals: GoalDistribution) -> None:
    one, same, other = (goals.sample(5, generator=torch.Generator().manual_seed(seed)) for seed in (1, 1, 2))
    assert torch.equal(one, same)
    assert not torch.equal(one, other)


@pytest.mark.parametrize("goals", [BOX, SECTOR])
def test_scaled_moves_points_and_box_alike(goals: GoalDistribution) -> None:
    scaled = goals.scaled(2.0, -1.0)
    u = torch.rand(10, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    assert type(scaled) is type(goals)
    torch.testing.assert_close(scaled.from_uniform(u), goals.from_uniform(u) * 2.0 - 1.0)
    torch.testing.assert_close(scaled.low, goals.low * 2.0 - 1.0)
    torch.testing.assert_close(scaled.high, goals.high * 2.0 - 1.0)


def test_a_box_may_be_flat() -> None:
    floor = BoxGoals((0.0, 0.5), (1.0, 0.5))
    assert set(floor.sample(100)[:, 1].tolist()) == {0.5}


@pytest.mark.parametrize(("low", "high"), [((1.0, 0.0), (0.0, 1.0)), ((0.0, 1.0), (1.0, 0.0))])
def test_a_box_upside_down_is_refused(low: tuple[float, float], high: tuple[float, float]) -> None:
    with pytest.raises(ValueError, match=r"low <= high, got low=\(.*\), high=\(.*\)"):
        BoxGoals(low, high)


@pytest.mark.parametrize("goals", [BOX, SECTOR])
def test_arrays_are_mapped_as_tensors_are(goals: GoalDistribution) -> None:
    u = np.random.default_rng(0).random((5, 3, 2))
    points = goals.from_uniform(u)
    assert isinstance(points, np.ndarray)
    np.testing.assert_allclose(points, goals.from_uniform(torch.from_numpy(u)).numpy(), rtol=0, atol=1e-14)
