"""Colors that the videos of all environments share."""

from __future__ import annotations

Color = tuple[int, int, int] | tuple[int, int, int, int]  # red, green, blue and opacity, each in 0 ... 255

MARGIN: Color = (236, 233, 226)  # color around pictures, and in empty places of a grid
INK: Color = (84, 82, 88)  # color of text
SUCCESS: Color = (64, 168, 98)  # border of an episode that achieved its goal
FAILURE: Color = (204, 96, 92)  # border of an episode that missed its goal
