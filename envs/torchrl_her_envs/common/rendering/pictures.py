"""What is done to finished pictures: size, caption, border, and many of them in one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from torchrl_her_envs.common.rendering.colors import INK, MARGIN, Color

_BORDER = 1 / 60  # of a picture's height: width of a border
_TEXT = 0.045  # of a picture's height: height of a caption


def resized(picture: Tensor, size: int) -> Tensor:
    """A picture [height, width, 3] of uint8 whose longer side has a given number of pixels.

    Raises:
        ValueError: ``size`` is below 1.

    Example:
        >>> resized(torch.zeros(40, 60, 3, dtype=torch.uint8), 30).shape
        torch.Size([20, 30, 3])
    """
    if size < 1:
        raise ValueError(f"a picture needs a size of at least 1 pixel, got {size}")
    scale = size / max(picture.shape[:2])
    height, width = (max(1, round(side * scale)) for side in picture.shape[:2])
    image = Image.fromarray(picture.numpy()).resize((width, height), Image.Resampling.BOX)
    return torch.from_numpy(np.array(image))


def captioned(picture: Tensor, words: str) -> Tensor:
    """A picture [height, width, 3] of uint8 with a line of text at the top right, on a plain strip.

    Example:
        >>> plain = torch.zeros(60, 90, 3, dtype=torch.uint8)
        >>> captioned(plain, "epoch 3").equal(plain), captioned(plain, "").equal(plain)
        (False, True)
    """
    if not words:
        return picture
    image = Image.fromarray(picture.numpy())
    draw = ImageDraw.Draw(image)
    height = max(6.0, _TEXT * image.height)
    font, place = ImageFont.load_default(size=height), (0.98 * image.width, 0.02 * image.height)
    # Pictures of any environment may have any color there.
    draw.rectangle(draw.textbbox(place, words, font=font, anchor="ra"), fill=MARGIN)
    draw.text(place, words, fill=INK, font=font, anchor="ra")
    return torch.from_numpy(np.array(image))


def bordered(picture: Tensor, color: Color) -> Tensor:
    """A picture [height, width, 3] of uint8 with a border drawn over its edge.

    Example:
        >>> bordered(torch.zeros(60, 60, 3, dtype=torch.uint8), (0, 255, 0))[0, 0].tolist()
        [0, 255, 0]
    """
    width = max(1, round(picture.shape[0] * _BORDER))
    framed = torch.tensor(color, dtype=torch.uint8).expand_as(picture).clone()
    framed[width:-width, width:-width] = picture[width:-width, width:-width]
    return framed


def tile(pictures: Sequence[Tensor], *, columns: int) -> Tensor:
    """Pictures of one size in a grid, filled row by row; places left over have the color of the margins.

    Args:
        pictures: [height, width, 3] of uint8 each.
        columns: pictures in a row.

    Returns:
        [rows * height, columns * width, 3].

    Raises:
        ValueError: ``columns`` is below 1.

    Example:
        >>> tile([torch.zeros(2, 2, 3, dtype=torch.uint8)] * 3, columns=2).shape
        torch.Size([4, 4, 3])
    """
    if columns < 1:
        raise ValueError(f"columns must be at least 1, got {columns}")
    empty = torch.tensor(MARGIN, dtype=torch.uint8).expand_as(pictures[0])
    missing = -len(pictures) % columns
    grid = torch.stack([*pictures, *[empty] * missing])
    return torch.cat([torch.cat(list(row), 1) for row in grid.split(columns)], 0)
