"""Sprites that are shaded pixel by pixel: a basketball and a black hole."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from torchrl_her_envs.throwing.rendering import palette
from torchrl_her_envs.throwing.rendering.palette import Color

Array = NDArray[np.float64]

# rotation of the basketball about x, y and z, so that seams cross off its center
_TILT = np.radians((24.0, -20.0, 14.0))
_SEAM_WIDTH = 0.07  # half of a seam's width, as a fraction of the radius
_HORIZON = 0.5  # dark part of the black hole, as a fraction of its radius
_RIM = 0.06  # width of the line at which the glow ends, as a fraction of the radius
_SWIRL = 2.2  # how far the arms of the glow are wound up, in radians for each factor of e in radius


@lru_cache(maxsize=16)
def basketball(radius: int) -> Image.Image:
    """Shades a basketball of a radius in pixels; the rest of the square is transparent.

    Example:
        >>> basketball(10).size
        (22, 22)
    """
    x, y, rim = _grid(radius)
    z = np.sqrt(np.clip(1 - rim**2, 0, 1))
    u, v, _ = np.einsum("ij,j...->i...", _rotation(), np.stack((x, y, z)))
    # Two great circles and a curve that bends away from one of them, as on a real ball.
    seams = np.minimum(
        np.minimum(np.abs(u), np.abs(v)), np.abs(np.sqrt(np.clip(u**2 - 0.55 * v**2, 0, 1)) - 0.55)
    )
    seam = _step(_SEAM_WIDTH - seams, radius) + _step(rim - 0.9, radius)
    light = 0.68 + 0.4 * np.clip(-0.45 * x + 0.55 * y + 0.7 * z, 0, 1)
    color = _mix(np.clip(_rgb(palette.BALL) * light[..., None], 0, 255), palette.SEAM, np.clip(seam, 0, 1))
    return _image(color, _step(1 - rim, radius))


@lru_cache(maxsize=16)
def black_hole(radius: int) -> Image.Image:
    """Shades a black hole whose swirling glow ends at a radius in pixels.

    Example:
        >>> black_hole(10).getpixel((11, 11))  # opaque and dark in the middle
        (18, 14, 32, 255)
    """
    x, y, r = _grid(radius)
    swirl = 0.5 + 0.5 * np.cos(2 * np.arctan2(y, x) + 2 * _SWIRL * np.log(np.maximum(r, 1e-3)))
    out = np.clip((r - _HORIZON) / (1 - _HORIZON), 0, 1)
    glow = _mix(np.broadcast_to(_rgb(palette.GLOW_INNER), (*r.shape, 3)), palette.GLOW_OUTER, out**0.7)
    inside = _step(_HORIZON - r, radius)
    color = _mix(glow, palette.HOLE, inside)
    shine = (1 - out**4) * (0.3 + 0.7 * swirl)
    rim = 0.6 * _step(r - 1 + _RIM, radius)
    return _image(color, np.maximum(np.maximum(inside, shine), rim) * _step(1 - r, radius))


def _grid(radius: int) -> tuple[Array, Array, Array]:
    """Returns x, y (upwards) and the distance from the center, in radii, of each pixel of the square."""
    along = (np.arange(2 * radius + 2) - radius - 0.5) / radius
    x, y = np.meshgrid(along, -along)
    return x, y, np.hypot(x, y)


def _rotation() -> Array:
    (a, b, c), (d, e, f) = np.cos(_TILT), np.sin(_TILT)
    about_x = np.array(((1, 0, 0), (0, a, -d), (0, d, a)))
    about_y = np.array(((b, 0, e), (0, 1, 0), (-e, 0, b)))
    about_z = np.array(((c, -f, 0), (f, c, 0), (0, 0, 1)))
    return about_z @ about_y @ about_x


def _step(inside: Array, radius: int) -> Array:
    """Returns 1 where ``inside`` (in radii) is positive, 0 elsewhere, with an edge one pixel wide."""
    return np.clip(inside * radius + 0.5, 0, 1)


def _rgb(color: Color) -> Array:
    return np.array(color[:3], dtype=np.float64)


def _mix(below: Array, above: Color, share: Array) -> Array:
    return below + (_rgb(above) - below) * share[..., None]


def _image(color: Array, opacity: Array) -> Image.Image:
    return Image.fromarray(np.dstack((color, 255 * opacity)).round().astype(np.uint8))
