"""The table of tasks, the constants of the world, and environments by name."""

import dataclasses

import pytest
import torch

from torchrl_her_envs import TASKS, BallPhysics, Task, WorldConfig, get_task, make_env

TABLE = {
    # name: effector, start of the ball, throws, wall, entries of the observation, of the action
    "hand_reach": ("hand", "away", False, False, 5, 3),
    "hand_v0": ("hand", "held", True, False, 9, 3),
    "hand_v1": ("hand", "away", True, False, 9, 3),
    "hand_v2": ("hand", "mixed", True, False, 9, 3),
    "hand_wall_v0": ("hand", "held", True, True, 9, 3),
    "hand_wall_v1": ("hand", "away", True, True, 9, 3),
    "hand_wall_v2": ("hand", "mixed", True, True, 9, 3),
    "robot_reach": ("arm", "away", False, False, 11, 3),
    "robot_v0": ("arm", "held", True, False, 15, 3),
    "robot_v1": ("arm", "away", True, False, 15, 3),
    "robot_v2": ("arm", "mixed", True, False, 15, 3),
}


def test_there_are_eleven_tasks() -> None:
    assert list(TASKS) == list(TABLE)


@pytest.mark.parametrize("name", TABLE)
def test_a_task_is_that_of_the_table(name: str) -> None:
    *facts, seen, done = TABLE[name]
    task, env = get_task(name), make_env(name, num_envs=2)
    assert [task.effector, task.start, task.throws, task.wall] == facts
    assert task.name == name
    assert task.summary
    assert env.observation_spec["observation"].shape == (2, seen)
    assert env.observation_spec["state"].shape == (2, seen + 2)
    assert env.observation_spec["achieved_goal"].shape == (2, 2)
    assert env.observation_spec["desired_goal"].shape == (2, 2)
    assert env.action_spec.shape == (2, done)
    assert env.task is TASKS[name]


def test_constants_of_the_thesis() -> None:
    world = WorldConfig()
    assert (world.gravity, world.bounce, world.friction, world.ball_mass) == (10.0, 0.7, 0.1, 3.0)
    assert world.arm_base == (0.33, 0.5)
    assert world.arm_length == pytest.approx(2.0)  # 300 px of 900 px that are 6 m
    assert (world.arm_start, world.arm_ball_angle) == ((180.0, 360.0), (75.0, 105.0))
    assert world.arm_ball_radius == (0.75, 1.0)


def test_constants_do_not_change_under_an_environment() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        WorldConfig().gravity = 9.81  # type: ignore[misc]


def test_unknown_task_lists_those_that_there_are() -> None:
    with pytest.raises(ValueError, match=r"unknown task 'hand_v9'; the tasks are hand_reach, .*, robot_v2$"):
        get_task("hand_v9")


@pytest.mark.parametrize("num_envs", [0, -3])
def test_no_environment_is_refused(num_envs: int) -> None:
    with pytest.raises(ValueError, match=f"num_envs must be at least 1, got {num_envs}"):
        make_env("hand_v0", num_envs=num_envs)


@pytest.mark.parametrize("threshold", [0.0, -0.1, float("nan")])
def test_a_threshold_that_nothing_meets_is_refused(threshold: float) -> None:
    with pytest.raises(ValueError, match=f"threshold must be positive, got {threshold}"):
        make_env("hand_v0", threshold=threshold)


def test_options_reach_the_environment() -> None:
    world = WorldConfig(gravity=0.0, max_steps=7, hole_radius=0.1)
    env = make_env("robot_v1", num_envs=5, world=world, num_links=3, dtype=torch.float64)
    assert env.world is world
    assert env.max_steps == 7
    assert env.batch_size == (5,)
    assert env.action_spec.shape == (5, 4)
    assert env.action_spec.dtype == torch.float64
    assert env.threshold == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"max_steps": 0}, "max_steps must be positive, got 0"),
        ({"hand_speed": -1.0}, "hand_speed must be positive, got -1.0"),
        ({"time_step": 0.0}, "time_step must be positive, got 0.0"),
        ({"size": float("nan")}, "size must be positive, got nan"),
        ({"size": float("inf")}, "size must be finite, got inf"),
        ({"gravity": float("nan")}, "gravity must be finite, got nan"),
        ({"bounce": 1.1}, "bounce must be from 0 to 1, got 1.1"),
        ({"bounce": -0.1}, "bounce must be from 0 to 1, got -0.1"),
        ({"bounce": float("nan")}, "bounce must be from 0 to 1, got nan"),
        ({"friction": -1.0}, "friction must be at least 0, got -1.0"),
        ({"friction": float("inf")}, "friction must be finite, got inf"),
        ({"substeps": 2.5}, "substeps must be a whole number, got 2.5"),
        ({"max_steps": 0.5}, "max_steps must be a whole number, got 0.5"),
    ],
)
def test_constants_that_cannot_be(options: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        WorldConfig(**options)


def test_numbers_of_steps_may_be_whole_floats() -> None:
    world = WorldConfig(substeps=4.0, max_steps=50.0)  # type: ignore[arg-type]
    assert [(type(own), own) for own in (world.substeps, world.max_steps)] == [(int, 4), (int, 50)]
    env = make_env("hand_wall_v1", world=world)
    assert env.max_steps == 50
    assert env.rollout(5).shape == (1, 5)  # it flies: substeps are counted


@pytest.mark.parametrize("gravity", [10.0, -10.0])
@pytest.mark.parametrize(
    ("substeps", "message"),
    [
        (1, "a wall needs at least 3 substeps, got 1: a ball of up to 15.7 m/s moves 0.63 m in a substep"),
        (2, "3 substeps, got 2: .* 0.315 m in a substep, .* half of the wall's thickness, 0.24 m together"),
    ],
)
def test_balls_that_could_pass_through_the_wall_are_refused(
    gravity: float, substeps: int, message: str
) -> None:
    world = WorldConfig(substeps=substeps, gravity=gravity)
    for task in (name for name in TASKS if get_task(name).wall):
        with pytest.raises(ValueError, match=message):
            make_env(task, world=world)
        make_env(task, world=dataclasses.replace(world, substeps=3))
    make_env("hand_v1", world=world)  # no wall to pass through
    make_env("robot_v1", world=world)


def test_a_wall_stops_balls_that_are_as_fast_as_can_be() -> None:
    world, starts = WorldConfig(substeps=3), torch.linspace(0.5, 2.5, 201, dtype=torch.float64)
    physics = BallPhysics(201, world, wall=True)
    position = torch.stack((starts, torch.ones_like(starts)), -1)
    velocity = torch.tensor([world.fastest_ball(2**0.5 * world.hand_speed), 0.0]).double().repeat(201, 1)
    came_back = torch.zeros(201, dtype=torch.bool)
    for _ in range(10):
        position, velocity = physics.step(position, velocity)
        assert position[:, 0].max() < 3.0
        came_back |= velocity[:, 0] < 0
    assert came_back.all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"effector": "foot"}, "effector must be one of hand, arm, got 'foot'"),
        ({"effector": "arm", "start": "hold"}, "start must be one of held, away, mixed, got 'hold'"),
    ],
)
def test_tasks_that_cannot_be(options: dict[str, str], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Task(name="own", **options)


@pytest.mark.parametrize("width", [1, 2, 4])
def test_actions_of_another_width_are_refused(width: int) -> None:
    env = make_env("hand_v1", num_envs=2)
    shown = env.reset()
    with pytest.raises(ValueError, match=rf"actions must be of shape \[2, 3\], got \[2, {width}\]"):
        env.step(shown.set("action", torch.zeros(2, width)))
