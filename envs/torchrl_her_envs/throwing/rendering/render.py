"""Pictures of throwing environments; no display is needed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import torch
from torch import Tensor

from torchrl_her_envs.common.goal_env import choose_indices
from torchrl_her_envs.throwing.effector import Effector
from torchrl_her_envs.throwing.goals import GoalDistribution
from torchrl_her_envs.throwing.rendering import palette, sprites
from torchrl_her_envs.throwing.rendering.canvas import MARGIN, Canvas, Point
from torchrl_her_envs.throwing.state import WorldState
from torchrl_her_envs.throwing.tasks import Task, WorldConfig

_LINE = 0.004  # thickness of the edges of regions, as a fraction of the screen
_TEXT = 0.045  # height of a caption, as a fraction of the screen


class Scene(Protocol):
    """Contents of a picture of a :class:`~torchrl_her_envs.ThrowingEnv` or of its core."""

    task: Task
    world: WorldConfig
    effector: Effector
    threshold: float
    worlds: WorldState

    @property
    def goal_distribution(self) -> GoalDistribution: ...


def render(
    env: Scene,
    worlds: int | Sequence[int] | None = None,
    *,
    size: int = 300,
    trail: Sequence[Tensor] = (),
    caption: str = "",
) -> Tensor:
    """Draws some environments of a batch as they are now, and changes nothing in them.

    The region that the hand or arm reaches is red, the region of goals is blue. A black hole is as large as
    its goal. Use :func:`~torchrl_her_envs.to_pixel` to find a point.

    Args:
        env: the throwing environment.
        worlds: an index, several, or None for all environments of the batch.
        size: side of each picture in pixels.
        trail: earlier values of ``env.worlds.ball`` ([N, 2] each), oldest first, drawn as fading dots.
        caption: a line of text at the top right, where no hand comes.

    Returns:
        Pictures [len(worlds), size, size, 3] of uint8; without the first dimension for a single index.

    Raises:
        ValueError: an index is out of range, or a size is too small.

    Example:
        >>> from torchrl_her_envs import make_env
        >>> env = make_env("hand_v1", num_envs=4)
        >>> _ = env.reset()
        >>> render(env, [0, 2], size=64).shape
        torch.Size([2, 64, 64, 3])
        >>> render(env, 3, size=64).shape
        torch.Size([64, 64, 3])
    """
    chosen = choose_indices(len(env.worlds.step), worlds)
    stage = _draw_stage(env, size)
    stage.text((0.98, 0.985), caption, height=_TEXT, fill=palette.INK)
    pictures = []
    for world in chosen:
        canvas = stage.copy()
        _draw_world(canvas, env, world, trail)
        pictures.append(canvas.finish())
    return pictures[0] if isinstance(worlds, int) else torch.stack(pictures)


def _draw_stage(env: Scene, size: int) -> Canvas:
    """Draws the parts that all pictures of a task share: the screen, the regions and the wall."""
    canvas = Canvas(size, background=palette.OUTSIDE)
    canvas.box((0.0, 0.0), (1.0, 1.0), fill=palette.PAPER, edge=palette.FRAME, width=_LINE)
    _draw_reach(canvas, env)
    _draw_goals(canvas, env)
    canvas.box((-MARGIN, -MARGIN), (1.0 + MARGIN, 0.0), fill=palette.FLOOR)
    canvas.box((-MARGIN, -_LINE), (1.0 + MARGIN, 0.0), fill=palette.FLOOR_LINE)
    if env.task.wall:
        middle, half = env.world.wall_x, env.world.wall_thickness / 2
        sprites.draw_wall(canvas, (middle - half, 0.0), (middle + half, env.world.wall_height))
    return canvas


def _draw_reach(canvas: Canvas, env: Scene) -> None:
    left, bottom, right, top = env.effector.reach
    if env.task.effector == "arm":
        center, radius = ((left + right) / 2, (bottom + top) / 2), (right - left) / 2
        canvas.disc(center, radius, fill=palette.REACH, edge=palette.REACH_EDGE, width=_LINE)
    else:
        canvas.box((left, bottom), (right, top), fill=palette.REACH, edge=palette.REACH_EDGE, width=_LINE)


def _draw_goals(canvas: Canvas, env: Scene) -> None:
    """Draws the region of the goals, whatever its shape, unless it is a line."""
    goals = env.goal_distribution
    if (goals.high > goals.low).all():
        along = torch.linspace(0, 1, 33, dtype=torch.float64)
        on, off = torch.ones_like(along), torch.zeros_like(along)
        sides = ((along, off), (on, along), (along.flip(0), on), (off, along.flip(0)))
        edge = torch.cat([goals.from_uniform(torch.stack(side, -1)) for side in sides])
        corners = _points((edge + 1) / 2)
        canvas.polygon(corners, fill=palette.GOALS, edge=palette.GOALS_EDGE, width=_LINE)


def _draw_world(canvas: Canvas, env: Scene, world: int, trail: Sequence[Tensor]) -> None:
    """Draws the parts that differ from one environment to the next, from the back to the front."""
    now, size, closed = env.worlds, env.world.size, bool(env.worlds.closed[world])
    grip = _point(now.grip[world] / size)
    if env.task.throws:
        # Goal and threshold are in observed coordinates, which span 2; the threshold is usually the radius.
        sprites.draw_hole(canvas, _point((now.goal[world] + 1) / 2), env.threshold / 2)
    sprites.draw_trail(canvas, [_point(balls[world] / size) for balls in trail])
    if env.task.effector == "arm":
        sprites.draw_arm(canvas, _points(env.effector.skeleton(now.joints[world]) / size), closed=closed)
    else:
        sprites.draw_palm(canvas, grip, closed=closed)
    sprites.draw_ball(canvas, _point(now.ball[world] / size), env.world.ball_radius)
    if env.task.effector == "hand" and closed:
        sprites.draw_fist(canvas, grip)


def _point(screen: Tensor) -> Point:
    x, y = screen.tolist()
    return x, y


def _points(screen: Tensor) -> list[Point]:
    return [_point(row) for row in screen]
