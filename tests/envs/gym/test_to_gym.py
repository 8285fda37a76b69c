"""Our tasks as gymnasium environments, one by one."""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from tensordict import TensorDict

from torchrl_her_envs import WorldConfig, make_env
from torchrl_her_envs.common.rendering.window import Window

from .tasks import IDS, make, make_many

KEYS = ("observation", "achieved_goal", "desired_goal")
NO_DISPLAY = "ignore:.*there is no display"


@pytest.mark.filterwarnings(NO_DISPLAY)
@pytest.mark.parametrize("task", IDS)
def test_gymnasium_s_checker_finds_no_fault(task: str) -> None:
    check_env(make(task, size=32).unwrapped)


@pytest.mark.parametrize("task", ["hand_v2", "hand_reach", "robot_v2"])
def test_a_environment_does_what_ours_does(task: str) -> None:
    env, own = make(task), make_env(task, seed=3)
    rng = np.random.default_rng(0)
    for episode in range(3):
        shown, info = env.reset(seed=3 if episode == 0 else None)
        expected = own.reset()
        assert info == {}
        for _ in range(60):
            for key in KEYS:
                assert shown[key].dtype == np.float32
                assert np.array_equal(shown[key], expected[key][0].numpy()), key
            assert env.observation_space.contains(shown)
            action = rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)
            after = own.step(TensorDict({"action": torch.from_numpy(action).unsqueeze(0)}, [1]))["next"]
            shown, reward, terminated, truncated, info = env.step(action)
            expected = after.exclude("reward")
            assert (reward, terminated, truncated) == (
                after["reward"].item(),
                after["terminated"].item(),
                after["truncated"].item(),
            )
            assert [type(value) for value in (reward, terminated, truncated)] == [float, bool, bool]
            assert info == {"is_success": terminated}
            if terminated or truncated:
                break


def test_what_was_returned_stays_as_it_is() -> None:
    env = make("hand_v2")
    kept = [env.reset(seed=0)[0]]
    env.action_space.seed(0)
    kept += [env.step(env.action_space.sample())[0] for _ in range(10)]
    copies = [{key: value.copy() for key, value in shown.items()} for shown in kept]
    kept[3]["observation"][:] = 7.0  # its goals are in arrays of their own
    for _ in range(10):
        env.step(env.action_space.sample())
    for index, (shown, copy) in enumerate(zip(kept, copies, strict=True)):
        for key in KEYS[index == 3 :]:
            assert np.array_equal(shown[key], copy[key])


def test_functions_of_goals_take_one_pair_or_many() -> None:
    env = make("hand_v0").unwrapped
    goal = np.zeros(2, np.float32)
    near, far = np.array([0.06, 0.07], np.float32), np.array([0.1, 0.1], np.float32)
    for other, reward in ((near, 0.0), (far, -1.0)):
        assert env.compute_reward(other, goal, {}) == reward
        assert env.compute_terminated(other, goal, {}) == (reward == 0.0)
        assert not env.compute_truncated(other, goal, {})
    many = np.stack([near, far, goal])
    infos = np.array([{}, {}, {}])
    rewards = env.compute_reward(many, np.stack([goal] * 3), infos)
    assert (rewards.shape, rewards.tolist()) == ((3,), [0.0, -1.0, 0.0])
    assert env.compute_terminated(many, goal, infos).tolist() == [True, False, True]
    assert env.compute_truncated(many, goal, infos).tolist() == [False] * 3
    goals = [[0.0, 0.0], [1, 1]], [0, 0]  # lists, too
    assert env.compute_reward(*goals, {}).tolist() == [0.0, -1.0]
    assert env.compute_terminated(*goals, {}).tolist() == [True, False]
    assert env.compute_truncated(*goals, {}).tolist() == [False, False]
    assert env.compute_reward([0, 0], [1, 1], {}) == -1.0


@pytest.mark.parametrize(("one", "other"), [((2,), (3, 2)), ((3, 2), (2,)), ((4, 1, 2), (3, 2))])
def test_functions_of_goals_broadcast(one: tuple[int, ...], other: tuple[int, ...]) -> None:
    env = make("hand_v0").unwrapped
    shape = np.broadcast_shapes(one, other)[:-1]
    for function in (env.compute_reward, env.compute_terminated, env.compute_truncated):
        assert function(np.zeros(one), np.zeros(other), {}).shape == shape


@pytest.mark.parametrize(
    ("options", "length"), [({}, 50), ({"max_episode_steps": 7}, 7), ({"max_episode_steps": 70}, 70)]
)
def test_the_time_limit_is_gymnasium_s(options: dict[str, int], length: int) -> None:
    env, many = make("robot_v1", **options), make_many("robot_v1", num_envs=2, **options)
    env.reset(seed=0)
    many.reset(seed=0)
    still = np.array([0.0, 0.0, -1.0], np.float32)  # an open hand leaves the ball in the air
    for step in range(1, length + 1):
        *_, terminated, truncated, _ = env.step(still)
        assert (terminated, truncated) == (False, step == length)
        assert many.step(np.stack([still] * 2))[3].tolist() == [step == length] * 2


def test_episodes_differ_and_unseeded_environments_too() -> None:
    one, other = make(), make()
    starts = [env.reset()[0]["desired_goal"].tolist() for env in (one, one, other)]
    starts.append(make_many().reset()[0]["desired_goal"][0].tolist())
    assert len({tuple(start) for start in starts}) == 4
    seeded = [
        one.reset(seed=1 << 70)[0]["desired_goal"].tolist() for _ in range(2)
    ]  # as large as gymnasium takes
    assert seeded[0] == seeded[1]


def test_options_reach_the_environment() -> None:
    env = make("robot_v1", num_links=3, threshold=0.5, world=WorldConfig(time_step=0.02))
    assert env.observation_space["observation"].shape == (18,)
    assert env.unwrapped.compute_reward(np.array([0.4, 0.0]), np.zeros(2), {}) == 0.0
    many = make_many("robot_v1", num_links=3)
    assert many.single_observation_space["observation"].shape == (18,)


def test_gravity_may_point_up() -> None:
    spaces = [make(world=WorldConfig(gravity=gravity)).observation_space for gravity in (20.0, -20.0)]
    assert spaces[0] == spaces[1]


@pytest.mark.parametrize("links", [1, 3, 6])
def test_arms_at_full_speed_stay_within_what_the_space_says(links: int) -> None:
    env = make("robot_v0", num_links=links, max_episode_steps=100, disable_env_checker=True)
    for seed in range(3):
        env.reset(seed=seed)
        for step in range(60):
            grip = 1.0 if step < 20 else -1.0
            shown, *_ = env.step(np.array([1.0] * links + [grip], np.float32))
            assert env.observation_space.contains(shown)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"render_mode": "ansi"}, "render_mode must be one of human, rgb_array, or None, got 'ansi'"),
        ({"threshold": -1.0}, "threshold must be positive, got -1.0"),
        ({"size": 0}, "a picture needs a size of at least 32 pixels, got 0"),
    ],
)
@pytest.mark.filterwarnings("ignore:.*that is not in the possible render_modes")
def test_options_that_cannot_be(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make(**options)


# Pictures


def test_a_picture_is_that_of_our_own_renderer() -> None:
    env, own = make("robot_v2", render_mode="rgb_array", size=64), make_env("robot_v2", seed=5)
    env.reset(seed=5)
    own.reset()
    assert np.array_equal(env.render(), own.render(0, size=64).numpy())
    assert env.metadata["render_fps"] == 25
    assert make().unwrapped.render() is None


def test_a_window_shows_each_state(monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[np.ndarray] = []
    monkeypatch.setattr(Window, "show", lambda self, picture: shown.append(picture))
    env = make(render_mode="human", size=32)
    with pytest.warns(UserWarning, match="there is no display for a window"):
        env.reset(seed=0)
    same = make(render_mode="rgb_array", size=32)
    same.reset(seed=0)
    for frame in range(3):
        assert len(shown) == frame + 1
        assert np.array_equal(shown[-1], same.render())
        action = env.action_space.sample()
        env.step(action)
        same.step(action)
    assert env.render() is None
    env.close()
    env.close()


# Other libraries


def test_the_checker_of_stable_baselines3_finds_no_fault() -> None:
    pytest.importorskip("stable_baselines3")
    checker = importlib.import_module("stable_baselines3.common.env_checker")
    checker.check_env(make("hand_reach").unwrapped)
