"""The scripted controllers solve every task, whatever runs the environment."""

from __future__ import annotations

from functools import cache

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.envs import Compose, EnvBase, RewardSum, StepCounter, TransformedEnv

from torchrl_her_envs import TASKS, make_controller, make_env


def first_episodes(episodes: TensorDictBase) -> Tensor:
    """Which steps [N, T, 1] of a rollout belong to the first episode of their world."""
    done = episodes["next", "done"].long()
    return done.cumsum(1) - done == 0


def play(env: EnvBase) -> TensorDictBase:
    """Fifty steps of the controller."""
    return env.rollout(50, make_controller(env), break_when_any_done=False)


@cache
def played(name: str) -> TensorDictBase:
    """What the controller does in 200 worlds of a task."""
    return play(make_env(name, num_envs=200, seed=1))


def success_rate(episodes: TensorDictBase) -> float:
    """The share of worlds whose first episode the controller solves."""
    solved = (episodes["next", "terminated"] & first_episodes(episodes)).any(1)
    return solved.double().mean().item()


@pytest.mark.parametrize("name", TASKS)
def test_solves_at_least_95_percent(name: str) -> None:
    assert success_rate(played(name)) >= 0.95


@pytest.mark.parametrize("name", ["hand_reach", "hand_wall_v2", "robot_v1"])
def test_solves_the_episodes_that_follow(name: str) -> None:
    env = make_env(name, num_envs=40, seed=3)
    after = env.rollout(120, make_controller(env), break_when_any_done=False)["next"]
    assert after["done"].sum() >= 3 * 40  # the worlds end, and start again, each at a time of its own
    assert after["terminated"].sum() >= 0.95 * after["done"].sum()


def test_solves_the_episodes_of_a_collector() -> None:
    env = make_env("hand_v1", num_envs=20, seed=4)
    collector = Collector(
        env,
        make_controller(env),
        frames_per_batch=20 * 30,
        total_frames=20 * 120,
        auto_register_policy_transforms=False,  # it keeps nothing that they could set back
    )
    batches = torch.cat([batch["next"] for batch in collector], 1)
    collector.shutdown()
    assert batches["done"].sum() >= 3 * 20
    assert batches["terminated"].sum() >= 0.95 * batches["done"].sum()


@pytest.mark.parametrize("name", ["hand_v2", "robot_v2"])
def test_knows_the_environment_below_transforms(name: str) -> None:
    env = make_env(name, num_envs=25, seed=5)
    assert success_rate(play(TransformedEnv(env, Compose(StepCounter(), RewardSum())))) >= 0.95


@pytest.mark.parametrize("name", ["hand_v0", "robot_v0"])
def test_aims_within_the_threshold_of_the_environment(name: str) -> None:
    env = make_env(name, num_envs=100, seed=6, threshold=0.06)  # of 0.1
    assert success_rate(play(env)) >= 0.95


@pytest.mark.parametrize("name", TASKS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_actions_fit_the_environment(name: str, dtype: torch.dtype) -> None:
    single = dtype == torch.float32
    episodes = played(name) if single else play(make_env(name, num_envs=10, seed=7, dtype=dtype))
    actions = episodes["action"]
    assert actions.dtype == dtype
    assert actions.shape == (*episodes.shape, 3)
    assert (actions.abs() <= 1).all()


@pytest.mark.parametrize("name", ["hand_wall_v2", "robot_v2", "robot_reach"])
def test_asks_for_the_same_actions_of_recorded_states(name: str) -> None:
    episodes = played(name)[:10]
    states = TensorDict({"state": episodes["state"]}, batch_size=episodes.batch_size)
    recorded = make_controller(make_env(name))(states)["action"]
    torch.testing.assert_close(recorded, episodes["action"])


def hand_state(
    *, grip: list[float], ball: list[float], velocity: list[float], closed: bool, goal: list[float]
) -> TensorDict:
    """A state of ``hand_v1`` in meters and meters a second; hand and ball have one velocity."""
    place = (torch.tensor([grip, ball, goal]) / 3 - 1).tolist()
    speed = [component / 8 for component in velocity]
    state = [*place[0], *speed, float(closed), *place[1], *speed, *place[2]]
    return TensorDict({"state": torch.tensor([state])}, batch_size=[1])


@pytest.mark.parametrize(
    ("height", "action"),
    [
        (3.0, [0.0, -1.0, -1.0]),  # far above the ball: down at full speed, open
        (0.38, [0.0, -0.625, 1.0]),  # 0.2 m above it: there in one step at 5 m/s, and closes
    ],
)
def test_closes_at_the_ball(height: float, action: list[float]) -> None:
    rest = {"ball": [1.0, 0.18], "velocity": [0.0, 0.0], "closed": False, "goal": [4.5, 3.0]}
    asked = make_controller(make_env("hand_v1"))(hand_state(grip=[1.0, height], **rest))["action"]
    torch.testing.assert_close(asked, torch.tensor([action]), rtol=0, atol=1e-5)


@pytest.mark.parametrize("closed", [True, False])
def test_lets_a_ball_fly_that_will_hit(closed: bool) -> None:
    # In 10 steps, 40 substeps of 0.01 s, it flies 2 m and falls by 5 * 0.01^2 * 40 * 39 = 0.78 m.
    point = [2.0, 3.78]
    state = hand_state(grip=point, ball=point, velocity=[5.0, 0.0], closed=closed, goal=[4.0, 2.9])
    action = make_controller(make_env("hand_v1"))(state)["action"]
    torch.testing.assert_close(action, torch.tensor([[0.0, 0.0, -1.0]]))


def test_holds_a_ball_that_would_miss() -> None:
    point = [2.0, 3.78]
    state = hand_state(grip=point, ball=point, velocity=[5.0, 0.0], closed=True, goal=[4.0, 4.0])
    assert make_controller(make_env("hand_v1"))(state)["action"][0, -1] == 1


@pytest.mark.parametrize("name", [name for name in TASKS if TASKS[name].throws])
def test_throws_once_and_lets_the_ball_be(name: str) -> None:
    episodes = played(name)
    closed = (episodes["action"][..., -1:] > 0) & first_episodes(episodes)
    opened = closed[:, :-1] & ~closed[:, 1:]  # at the latest where the first episode ends
    assert (opened.sum(1) == 1).double().mean() >= 0.95


def test_needs_a_throwing_environment() -> None:
    with pytest.raises(TypeError, match="ThrowingEnv"):
        make_controller(object())  # type: ignore[arg-type]


def test_needs_an_arm_of_two_links() -> None:
    with pytest.raises(ValueError, match="2 links, got num_links=3"):
        make_controller(make_env("robot_v0", num_links=3))
