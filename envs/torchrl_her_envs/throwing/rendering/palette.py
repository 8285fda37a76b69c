"""The colors of throwing pictures: red belongs to the hand or arm, blue to the goals."""

from __future__ import annotations

from torchrl_her_envs.common.rendering import colors
from torchrl_her_envs.common.rendering.colors import Color

OUTSIDE: Color = colors.MARGIN
PAPER: Color = (253, 252, 249)
FRAME: Color = (178, 171, 158)
FLOOR: Color = (214, 203, 184)
FLOOR_LINE: Color = (140, 126, 104)
INK: Color = colors.INK

REACH: Color = (226, 92, 80, 26)
REACH_EDGE: Color = (240, 172, 164)
GOALS: Color = (66, 126, 204, 32)
GOALS_EDGE: Color = (156, 188, 230)

BRICK: Color = (190, 112, 88)
MORTAR: Color = (226, 206, 190)
BRICK_EDGE: Color = (132, 76, 60)

BALL: Color = (246, 142, 62)
SEAM: Color = (122, 62, 30)
TRAIL: Color = (228, 118, 42)

HOLE: Color = (18, 14, 32)
GLOW_INNER: Color = (250, 150, 84)
GLOW_OUTER: Color = (104, 66, 186)

SKIN: Color = (250, 214, 170)
SKIN_EDGE: Color = (126, 80, 52)

METAL: Color = (120, 134, 154)
METAL_LIGHT: Color = (204, 212, 222)
METAL_EDGE: Color = (66, 76, 92)
GRIPPER: Color = (212, 56, 52)
