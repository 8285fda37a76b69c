"""Objects of the pictures: each function draws one of them."""

from __future__ import annotations

import math
from collections.abc import Sequence

from torchrl_her_envs.throwing.rendering import palette
from torchrl_her_envs.throwing.rendering.canvas import Canvas, Point
from torchrl_her_envs.throwing.rendering.textures import basketball, black_hole

_LINE = 0.005  # thickness of outlines, as a fraction of the screen like all lengths here
_FINGER = 0.0175  # thickness of a finger
_PALM = 0.035  # radius of the palm, a little more than the ball's
_SPREAD = ((128.0, 0.070), (104.0, 0.080), (80.0, 0.080), (56.0, 0.070))  # open fingers: degrees and length
_THUMB = (8.0, 0.066)
_LINK = 0.024  # thickness of the arm
_GRIPPER = 0.042  # outer radius of the arm's end effector: the ball fits in


def draw_ball(canvas: Canvas, center: Point, radius: float) -> None:
    """Draws a basketball."""
    canvas.stamp(basketball(canvas.pixels(radius)), center)


def draw_hole(canvas: Canvas, center: Point, radius: float) -> None:
    """Draws a black hole, whose glow ends where the goal does."""
    canvas.stamp(black_hole(canvas.pixels(radius)), center)


def draw_trail(canvas: Canvas, points: Sequence[Point]) -> None:
    """Draws past positions of a ball, oldest first, as dots that fade with age."""
    for age, point in enumerate(reversed(points)):
        freshness = 1 - age / len(points)
        canvas.disc(point, 0.004 + 0.005 * freshness, fill=(*palette.TRAIL[:3], round(60 + 110 * freshness)))


def draw_wall(canvas: Canvas, low: Point, high: Point) -> None:
    """Draws a column of bricks."""
    canvas.box(low, high, fill=palette.BRICK)
    thickness = high[0] - low[0]
    courses = round((high[1] - low[1]) / (0.7 * thickness))
    height = (high[1] - low[1]) / courses
    for course in range(courses):
        bottom = low[1] + course * height
        joint = low[0] + thickness * (0.35 if course % 2 else 0.65)
        canvas.box((low[0], bottom), (high[0], bottom + 0.15 * height), fill=palette.MORTAR)
        canvas.box((joint, bottom), (joint + 0.1 * thickness, bottom + height), fill=palette.MORTAR)
    canvas.box(low, high, edge=palette.BRICK_EDGE, width=0.6 * _LINE)


def draw_palm(canvas: Canvas, center: Point, *, closed: bool) -> None:
    """Draws the part of a hand behind the ball: the palm, and the fingers of an open hand."""
    x, y = center
    wrist, elbow = (x, y - 0.6 * _PALM), (x, y - 1.55 * _PALM)
    _outlined_bar(canvas, wrist, elbow, 1.15 * _PALM)
    if not closed:
        for degrees, length in (*_SPREAD, _THUMB):
            tip = (x + length * math.cos(math.radians(degrees)), y + length * math.sin(math.radians(degrees)))
            _outlined_bar(canvas, center, tip, _FINGER)
    canvas.disc(center, _PALM + _LINE, fill=palette.SKIN_EDGE)
    canvas.bar(wrist, elbow, thickness=1.15 * _PALM, fill=palette.SKIN)  # joins the wrist to the palm
    canvas.disc(center, _PALM, fill=palette.SKIN)


def draw_fist(canvas: Canvas, center: Point) -> None:
    """Draws the part of a closed hand in front of the ball: fingers bent over its top, and the thumb."""
    x, y = center
    for finger in (-1.5, -0.5, 0.5, 1.5):
        along = x + finger * 1.08 * _FINGER
        knuckle = y + 0.042 - 0.0045 * abs(finger)
        _outlined_bar(canvas, (along, knuckle), (along, y + 0.021), _FINGER)
    _outlined_bar(canvas, (x + 0.036, y - 0.014), (x + 0.022, y - 0.010), _FINGER)


def draw_arm(canvas: Canvas, joints: Sequence[Point], *, closed: bool) -> None:
    """Draws links with round joints on a base plate, and a red circle at the end, filled if closed."""
    _draw_base(canvas, joints[0])
    *elbows, end = joints
    for start, stop in zip(elbows, [*elbows[1:], _before(elbows[-1], end)], strict=True):
        canvas.bar(start, stop, thickness=_LINK, fill=palette.METAL_EDGE)
        canvas.bar(start, stop, thickness=_LINK - 2 * _LINE, fill=palette.METAL)
    for joint in elbows:
        canvas.disc(joint, 0.75 * _LINK, fill=palette.METAL_LIGHT, edge=palette.METAL_EDGE, width=_LINE)
    draw_gripper(canvas, end, closed=closed)


def draw_gripper(canvas: Canvas, center: Point, *, closed: bool) -> None:
    """Draws the end of an arm, wide enough for the ball."""
    fill = palette.GRIPPER if closed else None
    canvas.disc(center, _GRIPPER, fill=fill, edge=palette.GRIPPER, width=1.5 * _LINE)


def _draw_base(canvas: Canvas, center: Point) -> None:
    x, y = center
    half = 1.5 * _LINK
    low, high = (x - half, y - half), (x + half, y + half)
    canvas.box(
        low, high, fill=palette.METAL_LIGHT, edge=palette.METAL_EDGE, width=_LINE, rounding=0.4 * _LINK
    )
    for bolt in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
        canvas.disc((x + bolt[0] * 0.68 * half, y + bolt[1] * 0.68 * half), _LINE, fill=palette.METAL_EDGE)


def _before(start: Point, end: Point) -> Point:
    """Returns the point of a link at which the circle at its end begins."""
    share = max(0.0, 1 - (_GRIPPER + _LINK / 2 - _LINE) / math.dist(start, end))
    return start[0] + share * (end[0] - start[0]), start[1] + share * (end[1] - start[1])


def _outlined_bar(canvas: Canvas, start: Point, end: Point, thickness: float) -> None:
    canvas.bar(start, end, thickness=thickness + 2 * _LINE, fill=palette.SKIN_EDGE)
    canvas.bar(start, end, thickness=thickness, fill=palette.SKIN)
