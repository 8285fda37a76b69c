"""What is done to finished pictures."""

from __future__ import annotations

import pytest
import torch

from torchrl_her_envs.common.rendering import colors
from torchrl_her_envs.common.rendering.pictures import bordered, captioned, resized, tile


def test_tiles_go_row_by_row_and_places_left_over_are_plain():
    pictures = [torch.full((2, 4, 3), number, dtype=torch.uint8) for number in (10, 20, 30)]
    grid = tile(pictures, columns=2)
    assert grid.shape == (4, 8, 3)
    assert [int(grid[row, column, 0]) for row, column in ((0, 0), (0, 4), (2, 0))] == [10, 20, 30]
    assert tuple(grid[2, 4].tolist()) == colors.MARGIN


@pytest.mark.parametrize(
    ("shape", "size", "after"),
    [((4, 6), 12, (8, 12)), ((40, 20), 10, (10, 5)), ((100, 1), 10, (10, 1)), ((7, 7), 7, (7, 7))],
)
def test_the_longer_side_gets_the_size(shape, size, after):
    picture = torch.randint(256, (*shape, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    resulting = resized(picture, size)
    assert resulting.shape == (*after, 3)
    assert resulting.dtype == torch.uint8
    if shape == after:
        assert resulting.equal(picture)


def test_enlarged_pictures_keep_their_pixels():
    picture = torch.tensor([[0, 100], [200, 50]], dtype=torch.uint8).unsqueeze(-1).expand(2, 2, 3)
    large = resized(picture.contiguous(), 8)
    assert large.equal(picture.repeat_interleave(4, 0).repeat_interleave(4, 1))


@pytest.mark.parametrize("shade", [0, 128, 255])
def test_a_caption_can_be_read_on_any_background(shade):
    plain = torch.full((120, 160, 3), shade, dtype=torch.uint8)
    changed = captioned(plain, "epoch 3").ne(plain).any(-1)
    assert changed[:15].any()
    assert not changed[20:].any()
    written = captioned(plain, "epoch 3")[changed]
    assert written.float().mean(-1).max() - written.float().mean(-1).min() > 100


def test_a_border_leaves_the_inside_alone():
    plain = torch.full((120, 60, 3), 7, dtype=torch.uint8)
    framed = bordered(plain, colors.SUCCESS)
    assert framed[2:-2, 2:-2].equal(plain[2:-2, 2:-2])
    for edge in (framed[:2], framed[-2:], framed[:, :2], framed[:, -2:]):
        assert (edge == torch.tensor(colors.SUCCESS, dtype=torch.uint8)).all()
