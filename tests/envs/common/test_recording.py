"""Films show each environment's own episode, and how it ended."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDictBase
from torchrl.envs import StepCounter, TransformedEnv
from torchrl.envs.utils import ExplorationType, exploration_type

from torchrl_her_envs import ThrowingEnv, WorldConfig, make_env, record_episodes
from torchrl_her_envs.common.rendering import colors
from torchrl_her_envs.common.rendering.pictures import tile

from ..gym.walk import LAST, walk

SIZE = 48
SHORT = WorldConfig(max_steps=5)


class Still:
    """A policy that does nothing, and remembers what it was called with."""

    def __init__(self) -> None:
        self.calls: list[TensorDictBase] = []
        self.exploration: list[ExplorationType | None] = []
        self.grad: list[bool] = []

    def __call__(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.calls.append(tensordict.clone())
        self.exploration.append(exploration_type())
        self.grad.append(torch.is_grad_enabled())
        observation = tensordict["observation"]
        return tensordict.set("action", torch.zeros(*observation.shape[:-1], 3))


@pytest.fixture
def env() -> ThrowingEnv:
    return make_env("hand_reach", num_envs=4, seed=2, world=SHORT)


def corner(frame: torch.Tensor, world: int) -> tuple[int, ...]:
    """The color of the border of an environment in a grid of two columns."""
    return tuple(frame[world // 2 * SIZE, world % 2 * SIZE].tolist())


def test_a_frame_for_the_start_and_each_step_and_the_last_is_held_for_a_second_unless_told(env):
    assert len(record_episodes(env, Still(), size=SIZE)) == 1 + 5 + 25
    frames = record_episodes(env, Still(), size=SIZE, hold=3)
    assert len(frames) == 1 + 5 + 3
    assert all(frame.shape == (2 * SIZE, 2 * SIZE, 3) for frame in frames)
    assert all(frame.equal(frames[-1]) for frame in frames[-4:])


def test_a_failed_episode_gets_a_red_border_at_its_end(env):
    frames = record_episodes(env, Still(), size=SIZE, hold=0)
    assert [corner(frame, 0) for frame in frames[:-1]] == [colors.MARGIN] * 5
    assert [corner(frames[-1], world) for world in range(4)] == [colors.FAILURE] * 4


def test_a_environment_whose_goal_is_achieved_freezes_with_a_green_border(env):
    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        """Puts the hand of environment 1 on the ball in the second step; all hands move on."""
        if env.worlds.step[0] == 1:
            env.worlds.joints[1] = env.worlds.ball[1]
        action = torch.zeros(4, 3)
        action[:, 0] = -0.01
        return tensordict.set("action", action)

    frames = record_episodes(env, policy, size=SIZE, hold=0)
    assert len(frames) == 6  # the others go on
    green = [corner(frame, 1) == colors.SUCCESS for frame in frames]
    assert green == [False, False, True, True, True, True]
    frozen = [frame[:SIZE, SIZE:] for frame in frames[2:]]
    assert all(picture.equal(frozen[0]) for picture in frozen)


def test_filming_stops_when_all_environments_that_are_filmed_have_stopped(env):
    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        env.worlds.joints[1] = env.worlds.ball[1]
        return tensordict.set("action", torch.zeros(4, 3))

    frames = record_episodes(env, policy, worlds=[1], size=SIZE, hold=0)
    assert len(frames) == 2
    assert frames[0].shape == (SIZE, SIZE, 3)


def test_environments_and_columns(env):
    frames = record_episodes(env, Still(), worlds=[3, 0, 1], size=SIZE, columns=3, hold=0)
    assert frames[0].shape == (SIZE, 3 * SIZE, 3)
    env.set_seed(2)
    env.reset()
    assert frames[0].equal(tile(list(env.render([3, 0, 1], size=SIZE)), columns=3))


def test_the_policy_is_greedy_and_without_gradients(env):
    policy = Still()
    record_episodes(env, policy, size=SIZE)
    assert policy.exploration == [ExplorationType.DETERMINISTIC] * 5
    assert policy.grad == [False] * 5


def test_a_policy_sees_what_the_transforms_make_and_never_a_reset(env):
    policy = Still()
    record_episodes(TransformedEnv(env, StepCounter()), policy, size=SIZE)
    assert [call["step_count"].flatten().tolist() for call in policy.calls] == [
        [step] * 4 for step in range(5)
    ]
    assert env.worlds.episode.tolist() == [1] * 4


def test_a_trail_can_be_left_out():
    def film(*, trail: bool) -> torch.Tensor:
        env = make_env("hand_v0", world=WorldConfig(max_steps=15))
        return record_episodes(env, Still(), size=SIZE, trail=trail, hold=0)[-1]

    assert not film(trail=True).equal(film(trail=False))


def test_filming_is_repeatable():
    first, second = (
        record_episodes(make_env("robot_v2", num_envs=2, world=SHORT), Still(), size=SIZE) for _ in range(2)
    )
    assert all(a.equal(b) for a, b in zip(first, second, strict=True))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"worlds": [4]}, "worlds must be one or more indices from 0 to 3"),
        ({"size": 8}, "at least 32 pixels, got 8"),
        ({"columns": 0}, "columns must be at least 1, got 0"),
    ],
)
def test_wrong_options(env, options, message):
    with pytest.raises(ValueError, match=message):
        record_episodes(env, Still(), **options)


# Environments of other families


def walks_right(tensordict: TensorDictBase) -> TensorDictBase:
    return tensordict.set("action", torch.ones(tensordict.batch_size, dtype=torch.int64))


def test_any_environment_that_gives_pictures_is_filmed():
    env = walk(4, render_mode="rgb_array", seed=1)
    start = env.reset()
    env.set_seed(1)
    frames = record_episodes(env, walks_right, worlds=[0, 2], size=60, columns=1, hold=2)
    assert frames[0].shape == (2 * 40, 60, 3)  # the pictures are 4 by 6 pixels, enlarged
    assert len(frames) <= 1 + env.max_steps + 2
    places = start["observation"][[0, 2], 0].tolist()
    assert [frames[0][20 + 40 * row, 30, 0].item() for row in range(2)] == places
    ended = {tuple(frames[-1][40 * row, 0].tolist()) for row in range(2)}
    assert ended <= {colors.SUCCESS, colors.FAILURE}


def test_an_environment_that_must_be_reset_is_and_its_picture_stays():
    env = walk(8, render_mode="rgb_array", seed=3)
    frames = record_episodes(env, walks_right, size=60, columns=1, hold=0)
    assert len(frames) == 1 + env.max_steps  # some never come to their goal: it lies left of them
    rows = [frames[-1][40 * row : 40 * (row + 1)] for row in range(8)]
    successes = [row for row, picture in enumerate(rows) if tuple(picture[0, 0].tolist()) == colors.SUCCESS]
    assert 0 < len(successes) < 8
    for row in successes:
        history = [frame[40 * row : 40 * (row + 1)] for frame in frames]
        first = next(
            step for step, picture in enumerate(history) if tuple(picture[0, 0].tolist()) == colors.SUCCESS
        )
        assert all(picture.equal(history[first]) for picture in history[first:])
    assert all(0 <= rows[row][20, 30, 0] <= LAST for row in range(8))


def test_a_caption_is_in_films_of_any_environment():
    plain, captioned = (
        record_episodes(walk(render_mode="rgb_array"), walks_right, size=96, hold=0, caption=caption)[0]
        for caption in ("", "epoch 3")
    )
    assert not plain.equal(captioned)


def test_what_gives_no_pictures_cannot_be_filmed():
    with pytest.raises(ValueError, match="gym:tests/Walk-v0 cannot be filmed: it gives no pictures"):
        record_episodes(walk(), Still())
