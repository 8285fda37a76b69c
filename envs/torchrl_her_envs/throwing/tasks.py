"""Throwing and reaching tasks: their parts, the constants of their physics, and the table of all eleven."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

EffectorName = Literal["hand", "arm"]
Start = Literal["held", "away", "mixed"]

_POSITIVE = (
    "size",
    "pixels",
    "ball_mass",
    "time_step",
    "substeps",
    "max_steps",
    "hand_speed",
    "joint_speed",
    "ball_radius",
    "hole_radius",
    "wall_thickness",
    "arm_pixels",
)
_WHOLE = ("substeps", "max_steps")


@dataclass(frozen=True, kw_only=True)
class WorldConfig:
    """The constants of the world, in SI units unless a comment says otherwise.

    Values with the comment "screen" are fractions of the square screen's side, from the bottom left.
    The agent observes positions as ``2 * screen - 1``, so from -1 to 1, and speeds as a fraction of
    ``hand_speed`` (or ``joint_speed``).

    Raises:
        ValueError: a length, speed, mass or number is not positive and finite, a number of steps is not
            whole, gravity is not finite, bounce is outside of [0, 1], or friction is below 0.

    Example:
        >>> world = WorldConfig()
        >>> world.size, round(world.arm_length, 6)
        (6.0, 2.0)
        >>> world.shown(world.hole_radius)  # a length, in the coordinates that the agent sees
        0.1
    """

    size: float = 6.0  # side of the square screen
    pixels: int = 900  # the same side in pixels, the thesis's unit of length
    gravity: float = 10.0  # downward acceleration: thesis, appendix A
    bounce: float = 0.7  # share of the normal speed that a bounce keeps: thesis, appendix A
    friction: float = 0.1  # coefficient of kinetic friction: thesis, appendix A
    ball_mass: float = 3.0  # thesis, appendix A; only ratios of masses would matter
    time_step: float = 0.04  # duration of an action: 25 actions in a second
    substeps: int = 4  # physics steps in an action; the fastest ball moves 0.157 m in each: see check_wall
    max_steps: int = 50  # number of actions in an episode, which takes 2 s
    hand_speed: float = 8.0  # greatest speed in each direction: enough to throw across the screen
    joint_speed: float = 4.0  # greatest speed of each joint in rad/s
    ball_radius: float = 0.03  # of the screen; also the distance below which a hand catches or reaches a ball
    hole_radius: float = 0.05  # of the screen; also the distance below which a ball is at the goal
    hand_goals: tuple[float, float, float, float] = (0.55, 0.2, 0.95, 0.8)  # screen: left, bottom, right, top
    arm_goals: tuple[float, float, float, float] = (0.72, 0.2, 0.95, 0.8)  # screen: beyond the arm's reach
    wall_x: float = 0.5  # screen: x of the wall's middle
    wall_height: float = 0.5  # screen: from the floor to the top of the wall
    wall_thickness: float = 0.02  # screen: from the left to the right side of the wall
    arm_base: tuple[float, float] = (0.33, 0.5)  # screen: x and y of the base: thesis, appendix A
    arm_pixels: float = 300.0  # total length: thesis, appendix A
    arm_start: tuple[float, float] = (180.0, 360.0)  # first angles of joints in degrees: thesis, appendix A
    arm_ball_angle: tuple[float, float] = (75.0, 105.0)  # degrees: thesis, appendix A
    arm_ball_radius: tuple[float, float] = (0.75, 1.0)  # share of the arm's length: thesis, appendix A

    def __post_init__(self) -> None:
        for name in _POSITIVE:
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        for name in (*_POSITIVE, "gravity", "friction"):
            if not math.isfinite(getattr(self, name)):
                raise ValueError(f"{name} must be finite, got {getattr(self, name)}")
        if not 0.0 <= self.bounce <= 1.0:
            raise ValueError(f"bounce must be from 0 to 1, got {self.bounce}")
        if self.friction < 0.0:
            raise ValueError(f"friction must be at least 0, got {self.friction}")
        for name in _WHOLE:
            value = getattr(self, name)
            if value != int(value):
                raise ValueError(f"{name} must be a whole number, got {value}")
            object.__setattr__(self, name, int(value))  # a whole float, such as 4.0 from a file, is accepted

    def fastest_ball(self, thrown: float) -> float:
        """Returns an upper bound on the speed of a ball, in meters a second.

        A bounce gives no energy to a ball, so only the throw and a fall across the whole screen make it
        faster.

        Args:
            thrown: the highest speed at which it is thrown, in meters a second.

        Example:
            >>> WorldConfig(gravity=10.0, size=6.0).fastest_ball(11.0)
            15.524174696260024
        """
        return math.sqrt(thrown**2 + 2.0 * abs(self.gravity) * self.size)

    def check_wall(self, fastest: float) -> None:
        """Checks that no ball passes through the wall.

        Contacts are found at the end of each substep only. A ball that has then passed the middle of the wall
        is pushed out on the other side. So it must not move from first contact to the middle in one substep.

        Args:
            fastest: the highest speed of a ball, in meters a second.

        Raises:
            ValueError: a substep is too long for this speed.

        Example:
            >>> WorldConfig().check_wall(16.0)
            >>> WorldConfig(substeps=1).check_wall(16.0)
            Traceback (most recent call last):
            ...
            ValueError: a task with a wall needs at least 3 substeps, got 1: ...
        """
        room = (self.ball_radius + self.wall_thickness / 2) * self.size
        moved = fastest * self.time_step / self.substeps
        if moved > room:
            needed = math.ceil(fastest * self.time_step / room)
            raise ValueError(
                f"a task with a wall needs at least {needed} substeps, got {self.substeps}: a ball of up to "
                f"{fastest:.3g} m/s moves {moved:.3g} m in a substep, more than its radius and half of the "
                f"wall's thickness, {room:.3g} m together"
            )

    @property
    def arm_length(self) -> float:
        """Total length of the arm in meters."""
        return self.arm_pixels * self.size / self.pixels

    @staticmethod
    def shown(length: float) -> float:
        """Converts a length from fractions of the screen to the coordinates that the agent sees."""
        return 2.0 * length


@dataclass(frozen=True, kw_only=True)
class Task:
    """A task: the body that moves, the start of the ball, whether there is a wall, and the goal.

    Args:
        name: the name that ``make_env`` takes.
        effector: ``"hand"`` (moves freely in the left half) or ``"arm"``.
        start: the ball is ``"held"`` from the first step, ``"away"`` (on the floor, or in the air
            for the arm), or ``"mixed"``: held in half of the episodes.
        throws: whether the ball must reach a black hole; otherwise the effector must reach the ball.
        wall: whether a wall stands in the middle.
        goal_sigma: distance within which other goals help to learn a goal, as a share of the screen: the
            final sigma of IBS.
        summary: one-line description for users.

    Raises:
        ValueError: an unknown effector or start.
    """

    name: str
    effector: EffectorName
    start: Start = "away"
    throws: bool = True
    wall: bool = False
    goal_sigma: float = 0.2
    summary: str = ""

    def __post_init__(self) -> None:
        for name, known in (("effector", get_args(EffectorName)), ("start", get_args(Start))):
            if getattr(self, name) not in known:
                raise ValueError(f"{name} must be one of {', '.join(known)}, got {getattr(self, name)!r}")


TASKS: dict[str, Task] = {
    task.name: task
    for task in (
        Task(
            name="hand_reach", effector="hand", throws=False, summary="bring the hand to a ball on the floor"
        ),
        Task(name="hand_v0", effector="hand", start="held", summary="throw a held ball into the black hole"),
        Task(name="hand_v1", effector="hand", summary="pick the ball up from the floor and throw it"),
        Task(name="hand_v2", effector="hand", start="mixed", summary="as v0 or v1, at even odds"),
        Task(
            name="hand_wall_v0",
            effector="hand",
            start="held",
            wall=True,
            goal_sigma=0.1,  # smaller, since fewer goals near a goal behind the wall can be reached
            summary="throw a held ball over a wall",
        ),
        Task(
            name="hand_wall_v1",
            effector="hand",
            wall=True,
            summary="pick the ball up and throw it over a wall",
        ),
        Task(
            name="hand_wall_v2",
            effector="hand",
            start="mixed",
            wall=True,
            summary="as v0 or v1, at even odds",
        ),
        Task(
            name="robot_reach",
            effector="arm",
            throws=False,
            summary="bring the arm's end to a ball in the air",
        ),
        Task(name="robot_v0", effector="arm", start="held", summary="throw a held ball into the black hole"),
        Task(name="robot_v1", effector="arm", summary="catch the ball in the air and throw it"),
        Task(name="robot_v2", effector="arm", start="mixed", summary="as v0 or v1, at even odds"),
    )
}


def get_task(name: str) -> Task:
    """Returns the throwing or reaching task of a name.

    Raises:
        ValueError: no task has this name; the message lists all tasks.

    Example:
        >>> get_task("robot_v1").effector
        'arm'
    """
    if name not in TASKS:
        raise ValueError(f"unknown task {name!r}; the tasks are {', '.join(TASKS)}")
    return TASKS[name]
