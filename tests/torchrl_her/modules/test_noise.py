"""Random numbers of losses: each run's own."""

from __future__ import annotations

import pytest
import torch

from torchrl_her.modules import RunNoise


def test_a_run_draws_the_same_beside_others() -> None:
    alone = RunNoise([torch.Generator().manual_seed(7)])(torch.zeros(20, 3))
    beside = RunNoise([torch.Generator().manual_seed(seed) for seed in (1, 7, 5)])(torch.zeros(3, 20, 3))
    assert torch.equal(beside[1], alone)
    assert not torch.equal(beside[0], alone)


def test_subsets_are_those_of_each_run() -> None:
    many = RunNoise([torch.Generator().manual_seed(seed) for seed in (1, 7, 5)])
    alone = RunNoise([torch.Generator().manual_seed(7)])
    for _ in range(10):
        drawn = many.subsets(2, 10)
        assert drawn.shape == (3, 2)
        assert torch.equal(drawn[1:2], alone.subsets(2, 10))
        assert ((drawn[:, 0] >= 0) & (drawn[:, 0] < drawn[:, 1]) & (drawn[:, 1] < 10)).all()


def test_all_numbers_are_drawn_equally_often() -> None:
    noise = RunNoise([torch.Generator().manual_seed(0)])
    counts = torch.bincount(torch.cat([noise.subsets(2, 5) for _ in range(2_000)]).flatten(), minlength=5)
    assert counts.tolist() == pytest.approx([800] * 5, abs=120)  # six standard deviations


def test_without_generators_it_is_torchs_own() -> None:
    torch.manual_seed(4)
    drawn = RunNoise()(torch.zeros(2, 3))
    torch.manual_seed(4)
    assert torch.equal(drawn, torch.randn(2, 3))


def test_shape_and_type_are_kept() -> None:
    drawn = RunNoise([torch.Generator()])(torch.zeros(4, 2, dtype=torch.float64).t())
    assert drawn.shape == (2, 4)
    assert drawn.dtype == torch.float64


def test_subsets_are_drawn_where_the_generator_is() -> None:
    expected = RunNoise([torch.Generator().manual_seed(7)]).subsets(2, 10)
    with torch.device("meta"):  # another one than that of the generator
        drawn = RunNoise([torch.Generator("cpu").manual_seed(7)]).subsets(2, 10)
    assert torch.equal(drawn, expected)
