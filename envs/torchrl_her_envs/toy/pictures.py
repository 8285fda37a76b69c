"""Pictures of the toy environments: bits, a line with a treasure, a chain."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
import torch
from PIL import Image, ImageDraw
from torch import Tensor

from torchrl_her_envs.common.rendering.colors import FAILURE, INK, MARGIN, SUCCESS, Color

WIDTH = 300  # default width in pixels
_HEIGHT = 0.6  # height of a picture, as a fraction of its width
_FINER = 2  # factor by which pictures are drawn larger, for smooth edges
_MOST_CELLS = 400  # number of links of a chain up to which each link is drawn
_LIGHT: Color = (252, 251, 248)
_HAT: Color = (58, 56, 62)
_FACE: Color = (246, 205, 160)
_WOOD: Color = (150, 98, 56)
_GOLD: Color = (240, 190, 60)

Box = tuple[float, float, float, float]


class Sheet:
    """A sheet of paper, one unit wide, with the origin at its top left.

    Args:
        width: width of the sheet, in pixels.
    """

    def __init__(self, width: int) -> None:
        self._shape = width, max(1, round(_HEIGHT * width))
        self._unit = _FINER * width
        self._image = Image.new("RGB", (self._unit, _FINER * self._shape[1]), MARGIN)
        self._draw = ImageDraw.Draw(self._image)

    def box(self, box: Box, fill: Color, *, outline: Color | None = None, line: float = 0.0) -> None:
        """Draws a rectangle with round corners."""
        radius = min(box[2] - box[0], box[3] - box[1]) / 8
        self._draw.rounded_rectangle(
            self._pixels(box), radius * self._unit, fill, outline, max(1, round(line * self._unit))
        )

    def disk(self, box: Box, fill: Color, *, part: tuple[float, float] = (0, 360)) -> None:
        """Draws an ellipse, or a part of it between two angles in degrees, clockwise from the right."""
        self._draw.pieslice(self._pixels(box), *part, fill=fill)

    def line(self, first: tuple[float, float], second: tuple[float, float], width: float) -> None:
        """Draws a straight line."""
        self._draw.line(self._pixels((*first, *second)), fill=INK, width=max(1, round(width * self._unit)))

    def finish(self) -> Tensor:
        """Returns the finished picture [height, width, 3] of uint8."""
        small = self._image.resize(self._shape, Image.Resampling.BOX)
        return torch.from_numpy(np.array(small))

    def _pixels(self, box: Box) -> list[float]:
        return [self._unit * x for x in box]


def draw(width: int, on: Callable[[Sheet], None]) -> Tensor:
    """Returns the picture [height, width, 3] of uint8 that a function draws on a sheet.

    Raises:
        ValueError: ``width`` is below 1.

    Example:
        >>> draw(50, lambda sheet: None).shape
        torch.Size([30, 50, 3])
    """
    if width < 1:
        raise ValueError(f"a picture needs a size of at least 1 pixel, got {width}")
    sheet = Sheet(width)
    on(sheet)
    return sheet.finish()


def draw_bits(sheet: Sheet, bits: list[int], wanted: list[int]) -> None:
    """Draws bits, dark if they are set, with a green edge if they are right and a red one if not."""
    for box, bit, goal in zip(_cells(len(bits)), bits, wanted, strict=True):
        width = (box[2] - box[0]) / 8
        sheet.box(box, INK if bit else _LIGHT, outline=SUCCESS if bit == goal else FAILURE, line=width)


def draw_treasure(sheet: Sheet, pirate: float, treasure: float) -> None:
    """Draws a pirate on a line from 0 to 1, and a treasure."""
    ground, unit = 0.42, 0.05
    left, right = 0.08, 0.92
    sheet.line((left - unit, ground), (right + unit, ground), 0.008)
    for edge in (left - unit, right + unit):
        sheet.line((edge, ground - 0.03), (edge, ground + 0.03), 0.008)
    chest = left + (right - left) * treasure
    sheet.box((chest - unit, ground - 1.1 * unit, chest + unit, ground), _WOOD)
    sheet.box((chest - unit, ground - 0.85 * unit, chest + unit, ground - 0.6 * unit), _GOLD)
    sheet.box((chest - 0.2 * unit, ground - 0.85 * unit, chest + 0.2 * unit, ground - 0.3 * unit), _GOLD)
    x, head = left + (right - left) * pirate, ground - 2.4 * unit
    sheet.box((x - 0.5 * unit, head + 0.5 * unit, x + 0.5 * unit, ground - 0.2 * unit), FAILURE)
    for leg in (-0.25, 0.25):
        sheet.line((x + leg * unit, ground - 0.4 * unit), (x + leg * unit, ground), 0.01)
    sheet.disk((x - 0.7 * unit, head - 0.7 * unit, x + 0.7 * unit, head + 0.7 * unit), _FACE)
    sheet.disk((x - unit, head - 1.2 * unit, x + unit, head + 0.6 * unit), _HAT, part=(180, 360))
    sheet.disk((x + 0.1 * unit, head - 0.2 * unit, x + 0.5 * unit, head + 0.2 * unit), _HAT)


def draw_chain(sheet: Sheet, closed: int, length: int) -> None:
    """Draws the links of a chain, closed ones filled; the last one, the goal, has a green edge.

    A very long chain is drawn as a bar, filled up to the share of closed links.
    """
    if length > _MOST_CELLS:
        sheet.box((0.05, 0.25, 0.95, 0.35), _LIGHT, outline=INK, line=0.006)
        if closed:
            sheet.box((0.05, 0.25, 0.05 + 0.9 * closed / length, 0.35), INK)
        return
    for place, box in enumerate(_cells(length)):
        edge = SUCCESS if place == length - 1 else INK
        sheet.box(box, INK if place < closed else _LIGHT, outline=edge, line=(box[2] - box[0]) / 10)


def _cells(count: int) -> Iterator[Box]:
    """Yields the places of equal squares, row by row."""
    columns = max(1, min(count, math.ceil(math.sqrt(count / _HEIGHT))))
    rows = math.ceil(count / columns)
    pitch = min(0.92 / columns, 0.92 * _HEIGHT / rows, 0.2)
    left, top = (1 - pitch * columns) / 2, (_HEIGHT - pitch * rows) / 2
    gap = 0.06 * pitch
    for index in range(count):
        row, column = divmod(index, columns)
        x, y = left + pitch * column, top + pitch * row
        yield x + gap, y + gap, x + pitch - gap, y + pitch - gap
