"""Functions on finished pictures: scale them, add captions and borders, join several to one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from torchrl_her_envs.common.rendering.colors import INK, MARGIN, Color

_BORDER = 1 / 60  # width of a border, as a fraction of a picture's height
_TEXT = 0.045  # height of a caption, as a fraction of a picture's height
# height of a line of text: fraction of the width, limits in pixels
_LINE, _LEAST_LINE, _MOST_LINE = 0.055, 11, 18


def as_picture(drawn: Any, name: str, *, size: int | None = None) -> Tensor:
    """Returns a checked copy of a picture from an environment's ``render``, [height, width, 3] of uint8.

    Args:
        drawn: result of ``render``.
        name: name of the environment, for the message.
        size: length of the longer side in pixels; None keeps the size.

    Raises:
        ValueError: ``drawn`` is no such picture.

    Example:
        >>> as_picture(None, "walk")
        Traceback (most recent call last):
        ValueError: render() of walk must give a picture [height, width, 3] of uint8, got None
    """
    picture = np.array(drawn)
    if picture.ndim != 3 or picture.shape[-1] != 3 or picture.dtype != np.uint8:
        got = f"{list(picture.shape)} of {picture.dtype}" if picture.ndim else drawn
        raise ValueError(f"render() of {name} must give a picture [height, width, 3] of uint8, got {got}")
    return torch.from_numpy(picture) if size is None else resized(torch.from_numpy(picture), size)


def resized(picture: Tensor, size: int) -> Tensor:
    """Scales a picture [height, width, 3] of uint8 so that its longer side has a given number of pixels.

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
    """Adds a line of text at the top right of a picture [height, width, 3] of uint8, on a plain strip.

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
    # A strip behind the text, which keeps it readable on a picture of any color.
    draw.rectangle(draw.textbbox(place, words, font=font, anchor="ra"), fill=MARGIN)
    draw.text(place, words, fill=INK, font=font, anchor="ra")
    return torch.from_numpy(np.array(image))


def underlined(picture: Tensor, lines: Sequence[str]) -> Tensor:
    """Adds lines of text below a picture [height, width, 3] of uint8; long lines are set smaller.

    Example:
        >>> underlined(torch.zeros(60, 90, 3, dtype=torch.uint8), ["5 of 6", "step 3"]).shape
        torch.Size([92, 90, 3])
    """
    width = picture.shape[1]
    height = round(min(max(_LINE * width, _LEAST_LINE), _MOST_LINE))
    pitch = round(1.45 * height)
    strip = Image.new("RGB", (width, pitch * len(lines)), MARGIN)
    draw = ImageDraw.Draw(strip)
    for row, words in enumerate(lines):
        font = ImageFont.load_default(size=height)
        long = font.getlength(words) / (0.96 * width)
        font = ImageFont.load_default(size=max(6.0, height / max(long, 1.0)))
        draw.text((width / 2, (row + 0.5) * pitch), words, fill=INK, font=font, anchor="mm")
    return torch.cat([picture, torch.from_numpy(np.array(strip))])


def beside(pictures: Sequence[Tensor], *, gap: int) -> Tensor:
    """Joins pictures [height, width, 3] of uint8 in a row, with a gap between them, aligned at the top.

    Example:
        >>> high, low = (torch.zeros(height, 2, 3, dtype=torch.uint8) for height in (4, 3))
        >>> beside([high, low], gap=1).shape
        torch.Size([4, 5, 3])
    """
    high = max(picture.shape[0] for picture in pictures)
    parts = []
    for picture in pictures:
        below = high - picture.shape[0]
        parts += [_plain(high, gap), torch.cat([picture, _plain(below, picture.shape[1])])]
    return torch.cat(parts[1:], 1)


def _plain(height: int, width: int) -> Tensor:
    return torch.tensor(MARGIN, dtype=torch.uint8).expand(height, width, 3)


def bordered(picture: Tensor, color: Color) -> Tensor:
    """Draws a border over the edge of a picture [height, width, 3] of uint8.

    Example:
        >>> bordered(torch.zeros(60, 60, 3, dtype=torch.uint8), (0, 255, 0))[0, 0].tolist()
        [0, 255, 0]
    """
    width = max(1, round(picture.shape[0] * _BORDER))
    framed = torch.tensor(color, dtype=torch.uint8).expand_as(picture).clone()
    framed[width:-width, width:-width] = picture[width:-width, width:-width]
    return framed


def tile(pictures: Sequence[Tensor], *, columns: int) -> Tensor:
    """Joins pictures of one size in a grid, row by row; empty places have the color of the margins.

    Args:
        pictures: [height, width, 3] of uint8 each.
        columns: pictures in a row.

    Returns:
        The grid [rows * height, columns * width, 3].

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
