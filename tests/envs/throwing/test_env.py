"""What happens in one world: starts, catching, carrying, throwing, goals, and what the agent sees of it.

Numbers are worked out on paper: a step lasts 0.04 s, an action of 1 moves the hand by 8 m/s * 0.04 s = 0.32 m
and turns a joint by 0.16 rad, and the screen is 6 m, so that m meters are shown as m / 3 - 1.
"""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from torchrl_her_envs import TASKS, ThrowingEnv, make_env

HAND_TASKS = [name for name in TASKS if name.startswith("hand")]
ROBOT_TASKS = [name for name in TASKS if name.startswith("robot")]
THROWING_TASKS = [name for name in TASKS if not name.endswith("reach")]
OPEN, CLOSE = -1.0, 1.0


def make(name: str, *, num_envs: int = 1, **options: object) -> ThrowingEnv:
    env = make_env(name, num_envs=num_envs, dtype=torch.float64, **options)
    env.reset()
    return env


def points(*rows: list[float]) -> Tensor:
    return torch.tensor(rows, dtype=torch.float64)


def close(value: Tensor, *expected: list[float]) -> None:
    torch.testing.assert_close(value, points(*expected), rtol=0, atol=1e-9)


def covers(values: Tensor, low: float, high: float) -> bool:
    """Whether thousands of uniform numbers lie in a range, and fill it."""
    room = 0.01 * (high - low)
    inside = low - 1e-9 <= values.min() and values.max() <= high + 1e-9
    return bool(inside and values.min() < low + room and values.max() > high - room)


# Starts


@pytest.mark.parametrize("name", HAND_TASKS)
def test_the_hand_starts_anywhere_in_its_half(name: str) -> None:
    grip = make(name, num_envs=2048).worlds.grip
    assert covers(grip[:, 0], 0.18, 2.76 if "wall" in name else 2.82)
    assert covers(grip[:, 1], 0.18, 5.82)


@pytest.mark.parametrize("name", ["hand_reach", "hand_v1", "hand_wall_v1"])
def test_the_hands_ball_starts_on_the_floor_within_reach(name: str) -> None:
    ball = make(name, num_envs=2048).worlds.ball
    assert covers(ball[:, 0], 0.18, 2.76 if "wall" in name else 2.82)
    torch.testing.assert_close(ball[:, 1], torch.full((2048,), 0.18, dtype=torch.float64))


@pytest.mark.parametrize("name", ROBOT_TASKS)
def test_the_arm_hangs_at_180_to_360_degrees(name: str) -> None:
    joints = make(name, num_envs=2048).worlds.joints
    for joint in joints.unbind(-1):
        assert covers(joint, math.pi, 2 * math.pi)


@pytest.mark.parametrize("name", ["robot_reach", "robot_v1"])
def test_the_robots_ball_starts_in_the_air(name: str) -> None:
    offset = make(name, num_envs=2048).worlds.ball - points([1.98, 3.0])
    assert covers(offset.norm(dim=-1), 1.5, 2.0)  # 75 to 100 % of 2 m
    assert covers(torch.rad2deg(torch.atan2(offset[:, 1], offset[:, 0])), 75.0, 105.0)


@pytest.mark.parametrize(
    ("name", "low", "high"),
    [
        *((name, 0.0, 0.0) for name in ("hand_reach", "robot_reach", "hand_v1", "hand_wall_v1", "robot_v1")),
        *((name, 1.0, 1.0) for name in ("hand_v0", "hand_wall_v0", "robot_v0")),
        # 1024 fair coins have a standard deviation of 1/64: five of them either way
        *((name, 0.42, 0.58) for name in ("hand_v2", "hand_wall_v2", "robot_v2")),
    ],
)
def test_how_often_the_ball_starts_held(name: str, low: float, high: float) -> None:
    env = make(name, num_envs=1024)
    worlds = env.worlds
    assert low <= worlds.held.double().mean() <= high
    assert torch.equal(worlds.held, worlds.closed)
    assert torch.equal(worlds.ball[worlds.held], worlds.grip[worlds.held])
    falls = ~worlds.held & (name in HAND_TASKS)  # the robot's waits in the air
    assert torch.equal(worlds.free, falls)


@pytest.mark.parametrize("name", TASKS)
def test_everything_starts_at_rest(name: str) -> None:
    worlds = make(name, num_envs=16).worlds
    for speed in (worlds.joint_velocity, worlds.grip_velocity, worlds.ball_velocity, worlds.step):
        assert not speed.any()
    assert (worlds.episode == 1).all()


@pytest.mark.parametrize("name", THROWING_TASKS)
def test_black_holes_fill_their_box(name: str) -> None:
    env = make_env(name, num_envs=2048, dtype=torch.float64)
    goal = env.reset()["desired_goal"]
    left = 0.44 if name in ROBOT_TASKS else 0.1  # 0.72 or 0.55 of the screen, to 0.95
    assert covers(goal[:, 0], left, 0.9)
    assert covers(goal[:, 1], -0.6, 0.6)
    assert env.goal_distribution.is_box
    close(torch.stack((env.goal_distribution.low, env.goal_distribution.high)), [left, -0.6], [0.9, 0.6])


@pytest.mark.parametrize("name", ["hand_reach", "robot_reach"])
def test_where_to_reach_is_where_the_ball_is(name: str) -> None:
    env = make_env(name, num_envs=512, dtype=torch.float64)
    goal = env.reset()["desired_goal"]
    torch.testing.assert_close(goal, env.worlds.ball / 3 - 1)
    assert (goal >= env.goal_distribution.low - 1e-12).all()
    assert (goal <= env.goal_distribution.high + 1e-12).all()


# Moving, catching, carrying, throwing


def test_the_hand_moves_at_the_velocity_that_is_asked_for(put, act) -> None:
    env = make("hand_v1")
    put(env, joints=[1.0, 3.0], ball=[2.8, 0.18])
    act(env, [0.5, -0.25, OPEN])
    close(env.worlds.grip, [1.16, 2.92])
    close(env.worlds.grip_velocity, [4.0, -2.0])


@pytest.mark.parametrize(("name", "edge", "speed"), [("hand_v0", 2.82, 3.0), ("hand_wall_v0", 2.76, 1.5)])
def test_the_hand_stays_in_its_half_with_the_velocity_that_it_really_has(
    name: str, edge: float, speed: float, put, act
) -> None:
    env = make(name)
    put(env, joints=[2.70, 3.0], ball=[2.70, 3.0])
    act(env, [1.0, 0.0, CLOSE])
    close(env.worlds.ball, [edge, 3.0])
    close(env.worlds.ball_velocity, [speed, 0.0])  # 0.12 or 0.06 m in 0.04 s
    act(env, [1.0, 0.0, CLOSE])
    close(env.worlds.grip_velocity, [0.0, 0.0])


# While the hand stands still the ball falls 6 mm. The catch radius is 0.18 m.
@pytest.mark.parametrize(
    ("offset", "grip", "caught"),
    [
        ([0.0, 0.0], CLOSE, True),
        ([0.17, 0.0], CLOSE, True),
        ([0.0, 0.185], CLOSE, True),  # it falls into the hand
        ([0.12, 0.12], CLOSE, True),
        ([0.19, 0.0], CLOSE, False),
        ([0.14, 0.14], CLOSE, False),
        ([0.0, -0.175], CLOSE, False),  # it falls out of reach
        ([0.0, 0.0], OPEN, False),
        ([0.0, 0.0], 0.0, False),  # closes above 0 only
        ([0.0, 0.0], 0.01, True),
    ],
)
def test_a_closed_hand_over_the_ball_catches_it(
    offset: list[float], grip: float, caught: bool, put, act
) -> None:
    env = make("hand_v1")
    put(env, joints=[1.0, 3.0], ball=[1.0 + offset[0], 3.0 + offset[1]])
    act(env, [0.0, 0.0, grip])
    assert env.worlds.held.item() is caught
    assert env.worlds.free.item() is not caught
    assert env.worlds.closed.item() is (grip > 0)
    where, speed = ([1.0, 3.0], [0.0, 0.0]) if caught else ([1.0 + offset[0], 2.994 + offset[1]], [0.0, -0.4])
    close(env.worlds.ball, where)
    close(env.worlds.ball_velocity, speed)


def test_a_hand_that_arrives_closed_picks_the_ball_up_from_the_floor(put, act) -> None:
    env = make("hand_v1")
    put(env, joints=[1.0, 0.2], ball=[1.32, 0.18])
    act(env, [1.0, 0.0, CLOSE])
    assert env.worlds.held.item()
    close(env.worlds.ball, [1.32, 0.2])
    close(env.worlds.ball_velocity, [8.0, 0.0])


def test_a_held_ball_moves_with_the_hand(put, act) -> None:
    env = make("hand_v0")
    put(env, joints=[1.0, 3.0], ball=[1.0, 3.0])
    for step, (x, y) in enumerate([(1.16, 2.92), (1.32, 2.84), (1.48, 2.76)]):
        act(env, [0.5, -0.25, CLOSE])
        close(env.worlds.ball, [x, y])
        close(env.worlds.ball_velocity, [4.0, -2.0])
        assert env.worlds.step.item() == step + 1


def test_a_released_ball_keeps_the_velocity_that_the_hand_had_in_the_step_before(put, act) -> None:
    env = make("hand_v0")
    put(env, joints=[1.0, 3.0], ball=[1.0, 3.0])
    act(env, [0.5, 0.25, CLOSE])  # to (1.16, 3.08) at (4, 2) m/s
    act(env, [-1.0, -1.0, OPEN])  # the hand turns back: the ball does not know of it
    close(env.worlds.ball, [1.32, 3.154])  # + 0.04 * (4, 2) - (0, 0.006)
    close(env.worlds.ball_velocity, [4.0, 1.6])
    close(env.worlds.grip, [0.84, 2.76])
    assert not env.worlds.held.item()
    assert env.worlds.free.item()


def test_a_thrown_ball_can_be_caught_again(put, act) -> None:
    env = make("hand_v0")
    put(env, joints=[1.0, 3.0], ball=[1.0, 3.0])
    act(env, [0.0, 0.0, OPEN])
    act(env, [0.0, 0.0, CLOSE])
    assert env.worlds.held.item()
    close(env.worlds.ball, [1.0, 3.0])


def test_the_robots_ball_waits_in_the_air_until_it_was_held(put, act) -> None:
    env = make("robot_v1")
    up = [math.pi / 2, 0.0]
    put(env, joints=up, ball=[1.98, 5.0])  # the stretched arm's end is over it
    for _ in range(20):
        act(env, [0.0, 0.0, OPEN])
        close(env.worlds.ball, [1.98, 5.0])
        close(env.worlds.ball_velocity, [0.0, 0.0])
    act(env, [0.0, 0.0, CLOSE])
    assert env.worlds.held.item()
    act(env, [0.0, 0.0, OPEN])
    close(env.worlds.ball, [1.98, 4.994])
    close(env.worlds.ball_velocity, [0.0, -0.4])


def test_the_robots_ball_is_out_of_reach_at_more_than_its_radius(put, act) -> None:
    env = make("robot_v1", num_envs=2)
    put(env, joints=[math.pi / 2, 0.0], ball=points([1.98, 4.83], [1.98, 4.81]))
    act(env, [0.0, 0.0, CLOSE])
    assert env.worlds.held.tolist() == [True, False]
    close(env.worlds.ball, [1.98, 5.0], [1.98, 4.81])


def test_the_arm_throws_with_the_velocity_of_its_end(put, act) -> None:
    env = make("robot_v0")
    put(env, joints=[0.0, 0.0], ball=[3.98, 3.0])
    act(env, [0.5, 0.0, CLOSE])  # by 0.08 rad: the end moves on a circle of 2 m
    x, y = 1.98 + 2 * math.cos(0.08), 3.0 + 2 * math.sin(0.08)
    close(env.worlds.ball, [x, y])
    vx, vy = (x - 3.98) / 0.04, (y - 3.0) / 0.04
    act(env, [0.0, 0.0, OPEN])
    close(env.worlds.ball, [x + 0.04 * vx, y + 0.04 * vy - 0.006])
    close(env.worlds.ball_velocity, [vx, vy - 0.4])


# What is seen


def test_observation_of_the_hand_and_the_ball(put, act) -> None:
    env = make("hand_v1")
    put(env, joints=[1.0, 3.0], ball=[2.0, 4.0], goal=[0.7, -0.3])
    seen = act(env, [0.5, -0.25, OPEN])
    hand = [1.16 / 3 - 1, 2.92 / 3 - 1, 0.5, -0.25, 0.0]
    ball = [2.0 / 3 - 1, 3.994 / 3 - 1, 0.0, -0.05]  # 0.4 m/s down, an eighth of it
    close(seen["observation"], [*hand, *ball])
    close(seen["achieved_goal"], ball[:2])
    close(seen["desired_goal"], [0.7, -0.3])
    close(seen["state"], [*hand, *ball, 0.7, -0.3])


def test_observation_of_a_closed_hand_that_reaches(put, act) -> None:
    env = make("hand_reach")
    put(env, joints=[1.0, 3.0], goal=[-0.5, -0.94])
    seen = act(env, [0.5, -0.25, CLOSE])
    hand = [1.16 / 3 - 1, 2.92 / 3 - 1, 0.5, -0.25, 1.0]
    close(seen["observation"], hand)
    close(seen["achieved_goal"], hand[:2])
    close(seen["state"], [*hand, -0.5, -0.94])


def test_observation_of_the_arm_and_the_ball(put, act) -> None:
    env = make("robot_v1")
    put(env, joints=[math.pi / 2, 0.0], ball=[2.1, 4.6], goal=[0.7, -0.3])
    seen = act(env, [0.5, -0.25, OPEN])  # by 0.08 and -0.04 rad
    first, second = math.pi / 2 + 0.08, -0.04
    x = 1.98 + math.cos(first) + math.cos(first + second)
    y = 3.0 + math.sin(first) + math.sin(first + second)
    angles = [math.cos(first), math.cos(second), math.sin(first), math.sin(second)]
    grip = [x / 3 - 1, y / 3 - 1]
    speeds = [0.5, -0.25, (x - 1.98) / 0.04 / 8, (y - 5.0) / 0.04 / 8]
    ball = [2.1 / 3 - 1, 4.6 / 3 - 1, 0.0, 0.0]
    close(seen["observation"], [*angles, *grip, *speeds, 0.0, *ball])
    close(seen["state"], [*angles, *grip, *speeds, 0.0, *ball, 0.7, -0.3])
    close(seen["achieved_goal"], ball[:2])


def test_a_reaching_arm_is_judged_by_its_end(put, act) -> None:
    env = make("robot_reach")
    put(env, joints=[math.pi / 2, 0.0], goal=[-0.3, 0.6])
    seen = act(env, [0.0, 0.0, OPEN])
    assert seen["observation"].shape == (1, 11)
    close(seen["achieved_goal"], [1.98 / 3 - 1, 5.0 / 3 - 1])


# Rewards and ends


@pytest.mark.parametrize(("name", "threshold"), [("hand_reach", 0.06), ("hand_v1", 0.1), ("robot_v0", 0.1)])
def test_reward_is_0_within_the_threshold(name: str, threshold: float) -> None:
    env = make(name)
    goal = points([0.2, -0.1])
    for distance, reward in ((0.0, 0.0), (threshold - 1e-6, 0.0), (threshold + 1e-6, -1.0), (1.0, -1.0)):
        for direction in ([1.0, 0.0], [0.0, -1.0], [0.6, 0.8]):
            achieved = goal + distance * points(direction)
            assert env.compute_reward(achieved, goal).tolist() == [[reward]]
            assert env.compute_terminated(achieved, goal).tolist() == [[reward == 0.0]]


def test_rewards_broadcast() -> None:
    env = make("hand_v1")
    achieved = points([0.0, 0.0], [1.0, 0.0], [0.05, 0.05]).unsqueeze(1)
    desired = points([0.0, 0.0], [1.0, 0.05])
    rewards = env.compute_reward(achieved, desired).squeeze(-1)
    assert rewards.dtype == torch.float64
    assert rewards.tolist() == [[0.0, -1.0], [-1.0, 0.0], [0.0, -1.0]]


@pytest.mark.parametrize("name", TASKS)
def test_rewards_and_ends_are_those_of_the_goals_shown(name: str) -> None:
    env = make_env(name, num_envs=64, seed=3)
    torch.manual_seed(0)
    steps = env.rollout(60, break_when_any_done=False)
    after = steps["next"]
    goals = after["achieved_goal"], after["desired_goal"]
    assert torch.equal(after["reward"], env.compute_reward(*goals))
    assert torch.equal(after["terminated"], env.compute_terminated(*goals))
    assert torch.equal(after["done"], after["terminated"] | after["truncated"])


def test_an_episode_is_truncated_at_step_50_exactly(act) -> None:
    env = make("robot_v1", num_envs=3)  # an open hand leaves the ball where it is: no goal is ever achieved
    for step in range(1, 51):
        after = act(env, [0.0, 0.0, OPEN])
        assert after["truncated"].flatten().tolist() == [step == 50] * 3
        assert after["done"].flatten().tolist() == [step == 50] * 3
        assert not after["terminated"].any()


@pytest.mark.parametrize(("step", "truncated"), [(0, False), (48, False), (49, True)])
def test_a_goal_may_be_achieved_at_any_step(step: int, truncated: bool, put, act) -> None:
    env = make("hand_v0")
    put(env, joints=[1.5, 3.0], ball=[1.5, 3.0], goal=[-0.5, 0.0], step=step)
    after = act(env, [0.0, 0.0, CLOSE])
    assert after["reward"].item() == 0.0
    assert after["terminated"].item()
    assert after["truncated"].item() is truncated
    assert after["done"].item()


# Actions


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_actions_that_are_no_numbers_are_refused(bad: float, act) -> None:
    env = make("hand_v1", num_envs=3)
    with pytest.raises(
        ValueError, match=rf"actions must be finite, got \[0.0, {bad}, 0.0\] in environment 1"
    ):
        act(env, [0.0, 0.0, 0.0], [0.0, bad, 0.0], [0.0, 0.0, bad])


@pytest.mark.parametrize("name", ["hand_v2", "robot_v2"])
def test_actions_beyond_1_count_as_1(name: str, act) -> None:
    far, near = make(name, num_envs=8), make(name, num_envs=8)
    for _ in range(5):
        act(far, [3.0, -1e30, 7.0])
        act(near, [1.0, -1.0, 1.0])
    for field, value in far.world_state_dict().items():
        assert torch.equal(value, near.world_state_dict()[field]), field
