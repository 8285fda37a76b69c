"""The colours of all pictures: red belongs to the hand or arm, blue to the goals."""

from __future__ import annotations

Colour = tuple[int, int, int] | tuple[int, int, int, int]  # red, green, blue and opacity, each in 0 ... 255

OUTSIDE: Colour = (236, 233, 226)
PAPER: Colour = (253, 252, 249)
FRAME: Colour = (178, 171, 158)
FLOOR: Colour = (214, 203, 184)
FLOOR_LINE: Colour = (140, 126, 104)
INK: Colour = (84, 82, 88)

REACH: Colour = (226, 92, 80, 26)
REACH_EDGE: Colour = (240, 172, 164)
GOALS: Colour = (66, 126, 204, 32)
GOALS_EDGE: Colour = (156, 188, 230)

BRICK: Colour = (190, 112, 88)
MORTAR: Colour = (226, 206, 190)
BRICK_EDGE: Colour = (132, 76, 60)

BALL: Colour = (246, 142, 62)
SEAM: Colour = (122, 62, 30)
TRAIL: Colour = (228, 118, 42)

HOLE: Colour = (18, 14, 32)
GLOW_INNER: Colour = (250, 150, 84)
GLOW_OUTER: Colour = (104, 66, 186)

SKIN: Colour = (250, 214, 170)
SKIN_EDGE: Colour = (126, 80, 52)

METAL: Colour = (120, 134, 154)
METAL_LIGHT: Colour = (204, 212, 222)
METAL_EDGE: Colour = (66, 76, 92)
GRIPPER: Colour = (212, 56, 52)

SUCCESS: Colour = (64, 168, 98)
FAILURE: Colour = (204, 96, 92)
