"""Pictures show what the worlds are, and leave them as they are."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from torchrl_her_envs import TASKS, ThrowingEnv, make_env, render, to_pixel
from torchrl_her_envs.common.goal_env import choose_indices

SIZE = 160
METRES = 6.0  # side of the screen


def at(picture: Tensor, x: float, y: float) -> tuple[int, int, int]:
    """Red, green and blue where a point, in meters, is drawn."""
    red, green, blue = picture[to_pixel((x / METRES, y / METRES), SIZE)].tolist()
    return red, green, blue


def is_orange(color: tuple[int, int, int]) -> bool:
    red, green, blue = color
    return red > 150 and 0.75 * red > green > 1.3 * blue  # darker where a seam is near


def picture(env: ThrowingEnv, **options: object) -> Tensor:
    return render(env, 0, size=SIZE, **options)


@pytest.mark.parametrize("name", TASKS)
def test_every_task_draws(name):
    env = make_env(name, num_envs=2, seed=3)
    env.reset()
    pictures = render(env, size=SIZE)
    assert pictures.shape == (2, SIZE, SIZE, 3)
    assert pictures.dtype == torch.uint8
    assert not torch.equal(pictures[0], pictures[1])


@pytest.mark.parametrize(
    ("worlds", "shape"),
    [
        (0, (SIZE, SIZE, 3)),
        ([2], (1, SIZE, SIZE, 3)),
        ([2, 0], (2, SIZE, SIZE, 3)),
        (range(3), (3, SIZE, SIZE, 3)),
        (None, (3, SIZE, SIZE, 3)),
    ],
)
def test_the_environments_that_are_asked_for(worlds, shape):
    env = make_env("hand_v1", num_envs=3)
    env.reset()
    pictures = render(env, worlds, size=SIZE)
    assert pictures.shape == shape
    assert env.render(worlds, size=SIZE).equal(pictures)
    for picture, world in zip(pictures.view(-1, SIZE, SIZE, 3), choose_indices(3, worlds), strict=True):
        assert picture.equal(render(env, world, size=SIZE))


def test_the_method_draws_the_first_environment_at_300_pixels():
    env = make_env("robot_v1", num_envs=2)
    env.reset()
    assert env.render().equal(render(env, 0, size=300))


@pytest.mark.parametrize("name", ["hand_wall_v2", "robot_v2"])
def test_the_same_environments_give_the_same_picture_and_stay_as_they_are(name):
    env = make_env(name, num_envs=4, seed=1)
    env.rollout(7, break_when_any_done=False)
    before = env.world_state_dict()
    assert render(env, size=SIZE).equal(render(env, size=SIZE))
    after = env.world_state_dict()
    assert all(before[key].equal(after[key]) for key in before)


@pytest.mark.parametrize("point", [(1.0, 5.0), (3.0, 3.0), (5.5, 0.18)])
@pytest.mark.parametrize("name", ["hand_v1", "robot_v1"])
def test_the_ball_is_orange_where_it_is(put, name, point):
    env = make_env(name)
    env.reset()
    put(env, ball=point, goal=[0.6, 0.0])
    assert is_orange(at(picture(env), *point))


@pytest.mark.parametrize("name", ["hand_v0", "robot_v0"])
def test_a_held_ball_is_seen(put, name):
    env = make_env(name)
    env.reset()
    put(env, goal=[0.6, 0.0])
    assert bool(env.worlds.held[0])
    assert is_orange(at(picture(env), *env.worlds.grip[0].tolist()))


def test_the_black_hole_is_dark_in_its_middle_and_as_large_as_the_goal(put):
    env = make_env("hand_v1")
    env.reset()
    put(env, goal=[0.5, 0.0])  # in meters (4.5, 3)
    hole = picture(env)
    assert max(at(hole, 4.5, 3.0)) < 60
    put(env, goal=[0.5, 0.5])
    background = picture(env)
    # Its radius is 0.3; scaling down leaves a faint halo.
    assert abs(at(hole, 4.5 + 0.27, 3.0)[1] - at(background, 4.5 + 0.27, 3.0)[1]) > 30
    assert abs(at(hole, 4.5 + 0.36, 3.0)[1] - at(background, 4.5 + 0.36, 3.0)[1]) < 10


def test_a_wider_threshold_is_drawn_as_wide():
    narrow, wide = (make_env("hand_v1", threshold=threshold) for threshold in (0.1, 0.3))
    for env in (narrow, wide):
        env.reset()
    assert picture(wide).lt(60).all(-1).sum() > 4 * picture(narrow).lt(60).all(-1).sum()


@pytest.mark.parametrize("name", ["hand_v1", "robot_v1", "hand_reach"])
def test_open_and_closed_look_different(put, name):
    env = make_env(name)
    env.reset()
    put(env, closed=False)
    opened = picture(env)
    put(env, closed=True)
    assert (opened.int() - picture(env).int()).abs().amax(-1).gt(40).sum() > 50  # pixels


def test_the_arms_end_is_red_when_closed_and_empty_when_open(put):
    env = make_env("robot_v1")
    env.reset()
    put(env, joints=[0.0, -1.5], ball=[1.0, 5.0])
    grip = env.worlds.grip[0].tolist()
    put(env, closed=True)
    red, green, blue = at(picture(env), *grip)
    assert red > 180
    assert max(green, blue) < 80
    put(env, closed=False)
    assert min(at(picture(env), *grip)) > 200


def test_the_regions_are_red_and_blue(put):
    env = make_env("hand_v1")
    env.reset()
    put(env, joints=[0.5, 5.0], ball=[0.5, 0.18], goal=[0.8, 0.5])
    now = picture(env)
    reached, goals, neither = at(now, 2.0, 2.0), at(now, 4.0, 2.0), at(now, 4.0, 0.6)
    assert reached[0] > reached[2]
    assert goals[2] > goals[0]
    assert min(neither) > 245


def test_the_wall_stands_in_the_middle():
    with_wall, without = make_env("hand_wall_v1"), make_env("hand_v1")
    for env in (with_wall, without):
        env.reset()
    assert min(at(picture(without), 3.0, 1.5)) > 245
    assert min(at(picture(with_wall), 3.0, 1.5)) < 200
    assert min(at(picture(with_wall), 3.0, 3.5)) > 245  # above it


def test_a_trail_shows_where_the_ball_was():
    env = make_env("hand_v1", num_envs=2)
    env.reset()
    was = torch.tensor([[4.0, 0.6], [4.5, 0.6]]).double()
    plain, trailed = render(env, size=SIZE), render(env, size=SIZE, trail=[was])
    for world, x in ((0, 4.0), (1, 4.5)):
        assert at(plain[world], x, 0.6) != at(trailed[world], x, 0.6)
    assert at(plain[0], 4.5, 0.6) == at(trailed[0], 4.5, 0.6)  # the other world's


def test_a_caption_is_written_into_every_picture():
    env = make_env("hand_v1", num_envs=2)
    env.reset()
    plain, captioned = render(env, size=SIZE), render(env, size=SIZE, caption="epoch 3")
    assert plain.ne(captioned).flatten(1).any(1).all()


def test_an_arm_of_any_number_of_links():
    for links in (1, 2, 5):
        env = make_env("robot_v0", num_links=links)
        env.reset()
        assert picture(env).shape == (SIZE, SIZE, 3)
