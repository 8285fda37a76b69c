"""A square picture, drawn in fractions of the screen with y upwards."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from torchrl_her_envs.throwing.rendering.palette import Color

Point = tuple[float, float]

MARGIN = 0.04  # margin on each side, as a fraction of the screen, for a hand at the edge and for the floor
OVERSAMPLING = 3  # factor by which pictures are drawn larger and then scaled down, for smooth edges
SMALLEST = 32  # least side of a picture in pixels: smaller ones would show nothing


def to_pixel(point: Point, size: int) -> tuple[int, int]:
    """Returns the row and column of a picture at which a point of the screen is drawn.

    Args:
        point: fractions of the screen, (0, 0) at the bottom left.
        size: side of the picture in pixels.

    Example:
        >>> to_pixel((0.0, 1.0), 216)  # the top left corner of the screen lies within the margin
        (8, 8)
    """
    scale = size / (1 + 2 * MARGIN)
    return int((MARGIN + 1 - point[1]) * scale), int((MARGIN + point[0]) * scale)


def check_size(size: int) -> None:
    """Raises a ValueError for a picture that is too small to show anything."""
    if size < SMALLEST:
        raise ValueError(f"a picture needs a size of at least {SMALLEST} pixels, got {size}")


class Canvas:
    """Draws shapes, in fractions of the screen; colors with an opacity are blended with those below.

    Args:
        size: side of the finished picture in pixels.
        background: color of the background.

    Raises:
        ValueError: ``size`` is too small.

    Example:
        >>> canvas = Canvas(64, background=(255, 255, 255))
        >>> canvas.disc((0.5, 0.5), 0.2, fill=(255, 0, 0))
        >>> canvas.finish()[32, 32].tolist()
        [255, 0, 0]
    """

    def __init__(self, size: int, *, background: Color) -> None:
        check_size(size)
        self.size = size
        self._scale = size * OVERSAMPLING / (1 + 2 * MARGIN)
        self._use(Image.new("RGB", (size * OVERSAMPLING, size * OVERSAMPLING), background))

    def copy(self) -> Canvas:
        """Returns a canvas with a copy of this one's shapes."""
        copy = object.__new__(Canvas)
        copy.size, copy._scale = self.size, self._scale
        copy._use(self._image.copy())
        return copy

    def finish(self) -> Tensor:
        """Returns the picture as [size, size, 3] of uint8."""
        return torch.from_numpy(np.array(self._image.reduce(OVERSAMPLING)))

    def pixels(self, length: float) -> int:
        """Converts a length to pixels of the large picture, at least 1."""
        return max(1, round(length * self._scale))

    def disc(
        self,
        center: Point,
        radius: float,
        *,
        fill: Color | None = None,
        edge: Color | None = None,
        width: float = 0,
    ) -> None:
        """Draws a disc, a ring, or both; ``radius`` is the outer one and the edge lies within it."""
        x, y = self._at(center)
        r = radius * self._scale
        self._draw.ellipse((x - r, y - r, x + r, y + r), fill=fill, outline=edge, width=self.pixels(width))

    def box(
        self,
        low: Point,
        high: Point,
        *,
        fill: Color | None = None,
        edge: Color | None = None,
        width: float = 0,
        rounding: float = 0,
    ) -> None:
        """Draws an upright rectangle, optionally with round corners."""
        (left, bottom), (right, top) = self._at(low), self._at(high)
        self._draw.rounded_rectangle(
            (left, top, right, bottom),
            rounding * self._scale,
            fill=fill,
            outline=edge,
            width=self.pixels(width),
        )

    def polygon(
        self,
        corners: Iterable[Point],
        *,
        fill: Color | None = None,
        edge: Color | None = None,
        width: float = 0,
    ) -> None:
        """Draws a closed polygon."""
        points = [self._at(corner) for corner in corners]
        self._draw.polygon(points, fill=fill, outline=edge, width=self.pixels(width))

    def bar(self, start: Point, end: Point, *, thickness: float, fill: Color) -> None:
        """Draws a line with round ends."""
        self._draw.line((self._at(start), self._at(end)), fill=fill, width=self.pixels(thickness))
        self.disc(start, thickness / 2, fill=fill)
        self.disc(end, thickness / 2, fill=fill)

    def stamp(self, sprite: Image.Image, center: Point) -> None:
        """Draws a small picture with opacity, at the scale of the large one, centered at a point."""
        x, y = self._at(center)
        corner = (round(x - sprite.width / 2), round(y - sprite.height / 2))
        self._image.paste(sprite, corner, sprite)

    def text(self, place: Point, words: str, *, height: float, fill: Color) -> None:
        """Draws a line of text with its top right corner at a point."""
        font = ImageFont.load_default(size=height * self._scale)
        self._draw.text(self._at(place), words, fill=fill, font=font, anchor="ra")

    def _use(self, image: Image.Image) -> None:
        self._image = image
        self._draw = ImageDraw.Draw(image, "RGBA")  # blends colors on an RGB image

    def _at(self, point: Point) -> Point:
        return (MARGIN + point[0]) * self._scale, (MARGIN + 1 - point[1]) * self._scale
