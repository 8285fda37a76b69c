"""Makes ``images/tasks.png``: all eleven tasks, most of them in the middle of a throw.

Run it as ``python docs/make_pictures.py``; it needs nothing but the library.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from PIL import Image, ImageDraw, ImageFont
from tensordict import TensorDict
from torch import Tensor

from torchrl_her_envs import TASKS, ThrowingEnv, make_env, render, to_pixel
from torchrl_her_envs.throwing.experts.ballistics import fallen
from torchrl_her_envs.throwing.experts.inverse_kinematics import turn, two_link_angles
from torchrl_her_envs.throwing.rendering import palette, sprites
from torchrl_her_envs.throwing.rendering.canvas import Canvas, Point
from torchrl_her_envs.throwing.rendering.palette import Color

IMAGES = Path(__file__).parent / "images"
COLUMNS, SIDE, GAP, CAPTION = 4, 330, 16, 52  # pixels; 4 * 330 + 5 * 16 = 1400


@dataclass(frozen=True, kw_only=True)
class Scene:
    """What a picture shows; points are fractions of the screen.

    The ball is carried along ``path`` and leaves its end so as to be at the goal after ``flight``
    time steps; the picture is taken after ``shown`` of them. Without a flight the ball is still
    held. In a reaching task the grip is at the start of the path and the ball at its end.
    """

    path: tuple[Point, ...]
    goal: Point = (0.5, 0.5)
    flight: int = 0
    shown: int = 0


SCENES = {
    "hand_reach": Scene(path=((0.20, 0.26), (0.33, 0.03))),
    "hand_v0": Scene(path=((0.12, 0.40), (0.30, 0.62)), goal=(0.86, 0.62), flight=16, shown=11),
    "hand_v1": Scene(path=((0.16, 0.03), (0.12, 0.30), (0.34, 0.52)), goal=(0.74, 0.30), flight=15, shown=10),
    "hand_v2": Scene(path=((0.22, 0.24), (0.14, 0.52), (0.32, 0.66)), goal=(0.70, 0.70)),
    "hand_wall_v0": Scene(path=((0.18, 0.36), (0.32, 0.56)), goal=(0.80, 0.34), flight=19, shown=12),
    "hand_wall_v1": Scene(
        path=((0.36, 0.03), (0.14, 0.22), (0.30, 0.46)), goal=(0.68, 0.56), flight=18, shown=13
    ),
    "hand_wall_v2": Scene(path=((0.10, 0.62), (0.36, 0.74)), goal=(0.88, 0.24), flight=16, shown=9),
    "robot_reach": Scene(path=((0.52, 0.58), (0.36, 0.79))),
    "robot_v0": Scene(
        path=((0.22, 0.28), (0.38, 0.20), (0.56, 0.36)), goal=(0.88, 0.58), flight=16, shown=10
    ),
    "robot_v1": Scene(path=((0.30, 0.81), (0.40, 0.80), (0.56, 0.68)), goal=(0.82, 0.30), flight=11, shown=7),
    "robot_v2": Scene(path=((0.18, 0.30), (0.38, 0.20), (0.58, 0.34)), goal=(0.80, 0.70)),
}

LEGEND = (  # heights, and what is there
    (0.93, "within reach"),
    (0.77, "goals"),
    (0.61, "ball"),
    (0.45, "black hole"),
    (0.27, "hand"),
    (0.08, "gripper"),
)


def picture(name: str) -> Image.Image:
    """The scene of a task."""
    env, scene = make_env(name), SCENES[name]
    env.reset()
    path = torch.tensor(scene.path, dtype=torch.float64).unsqueeze(1) * env.world.size
    put(env, joints=joints_at(env, path[0]), grip=path[0], ball=path[0] if env.task.throws else path[-1])
    trail = play(env, scene, path) if env.task.throws else []
    return Image.fromarray(render(env, 0, size=SIDE, trail=trail[:-1]).numpy())


def play(env: ThrowingEnv, scene: Scene, path: Tensor) -> list[Tensor]:
    """Carries the ball along the path and throws it; returns where it was."""
    put(env, goal=2 * torch.tensor([scene.goal]) - 1, held=torch.tensor([True]))
    trail = [place for point in path for place in carry(env, point)]
    if scene.flight:
        put(env, ball_velocity=velocity(env, scene), held=torch.tensor([False]), free=torch.tensor([True]))
    still = torch.zeros(1, env.effector.num_joints)
    return trail + [step(env, still, closed=False) for _ in range(scene.shown)]


def put(env: ThrowingEnv, **values: Tensor) -> None:
    """Writes over a part of the state of a single world."""
    state = env.world_state_dict()
    env.load_world_state_dict(state | {name: value.to(state[name].dtype) for name, value in values.items()})


def joints_at(env: ThrowingEnv, point: Tensor) -> Tensor:
    """The joints that bring the grip to a point [1, 2] in meters."""
    if env.task.effector == "hand":
        return point
    base = torch.tensor(env.world.arm_base, dtype=torch.float64) * env.world.size
    return two_link_angles(point, base, env.world.arm_length)[:, 0]


def carry(env: ThrowingEnv, point: Tensor) -> list[Tensor]:
    """Moves the grip with the ball to a point; returns where the ball went on the way."""
    reach = env.effector.action_speed * env.world.time_step
    target, path = joints_at(env, point), []
    while not torch.allclose(env.worlds.grip, point, atol=1e-3):
        gap = target - env.worlds.joints
        change = turn(torch.zeros_like(gap), gap) if env.task.effector == "arm" else gap
        path.append(step(env, change / max(reach, float(change.abs().max())), closed=True))
    return path


def step(env: ThrowingEnv, speeds: Tensor, *, closed: bool) -> Tensor:
    """One time step; returns where the ball is."""
    grip = torch.tensor([[1.0 if closed else -1.0]])
    env.step(TensorDict({"action": torch.cat((speeds, grip), -1).float()}, batch_size=env.batch_size))
    return env.worlds.ball.clone()


def velocity(env: ThrowingEnv, scene: Scene) -> Tensor:
    """With which the ball is at the goal after the flight."""
    drop = fallen(torch.tensor(float(scene.flight * env.world.substeps)), env.world)
    way = torch.tensor([scene.goal]) * env.world.size - env.worlds.ball + torch.tensor([0.0, 1.0]) * drop
    return way / (scene.flight * env.world.time_step)


def legend() -> Image.Image:
    """What the things in the other pictures are."""
    canvas = Canvas(SIDE, background=palette.OUTSIDE)
    left, half = 0.12, 0.042
    reach, goals, ball, hole, hand, arm = (y for y, _ in LEGEND)
    draw_swatch(canvas, (left, reach), half, palette.REACH, palette.REACH_EDGE)
    draw_swatch(canvas, (left, goals), half, palette.GOALS, palette.GOALS_EDGE)
    sprites.draw_ball(canvas, (left, ball), 0.03)
    sprites.draw_hole(canvas, (left, hole), 0.05)
    sprites.draw_palm(canvas, (left - 0.065, hand), closed=False)
    sprites.draw_palm(canvas, (left + 0.065, hand), closed=True)
    sprites.draw_fist(canvas, (left + 0.065, hand))
    sprites.draw_gripper(canvas, (left - 0.06, arm), closed=False)
    sprites.draw_gripper(canvas, (left + 0.06, arm), closed=True)
    image = Image.fromarray(canvas.finish().numpy())
    for y, words in LEGEND:
        row, column = to_pixel((0.3, y), SIDE)
        font = ImageFont.load_default(size=34)
        ImageDraw.Draw(image).text((column, row), words, fill=palette.INK, font=font, anchor="lm")
    return image


def draw_swatch(canvas: Canvas, center: Point, half: float, fill: Color, edge: Color) -> None:
    """A piece of a region, on the color of the screen."""
    low, high = (center[0] - half, center[1] - half), (center[0] + half, center[1] + half)
    canvas.box(low, high, fill=palette.PAPER)
    canvas.box(low, high, fill=fill, edge=edge, width=0.005)


def sheet() -> Image.Image:
    """All tasks in a grid, each with its name, in letters that can be read at 400 pixels, and the legend."""
    cells = [(picture(name), name) for name in TASKS] + [(legend(), "")]
    rows = -(-len(cells) // COLUMNS)
    image = Image.new("RGB", (COLUMNS * (SIDE + GAP) + GAP, rows * (SIDE + CAPTION) + GAP), "white")
    draw = ImageDraw.Draw(image)
    for index, (cell, name) in enumerate(cells):
        x, y = GAP + index % COLUMNS * (SIDE + GAP), GAP + index // COLUMNS * (SIDE + CAPTION)
        image.paste(cell, (x, y))
        draw.text((x, y + SIDE + 3), name, fill=palette.INK, font=ImageFont.load_default(size=36))
    return image


if __name__ == "__main__":
    IMAGES.mkdir(exist_ok=True)
    sheet().save(IMAGES / "tasks.png", optimize=True)
