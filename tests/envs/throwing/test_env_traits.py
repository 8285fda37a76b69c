"""What throwing environments say of their task: stages, boxes, regions, pictures."""

from __future__ import annotations

import pytest
import torch

from torchrl_her_envs import TASKS, make_env

THROWS = [name for name, task in TASKS.items() if task.throws]
REACHES = [name for name, task in TASKS.items() if not task.throws]


@pytest.mark.parametrize("name", THROWS)
def test_the_stages_are_the_reach_and_the_throw(name: str) -> None:
    env = make_env(name, num_envs=3)
    reach, throw = env.stages()
    assert (reach["name"], throw["name"]) == ("reach", "throw")
    assert (reach["instructive"], throw["instructive"]) == (False, True)
    assert reach["threshold"] == pytest.approx(0.06)
    assert "threshold" not in throw
    shown = env.reset()
    state, width = shown["state"], shown["observation"].shape[-1]
    assert torch.equal(state[:, throw["observation"]], shown["observation"])
    assert torch.equal(state[:, throw["achieved_goal"]], shown["achieved_goal"])
    assert torch.equal(state[:, throw["desired_goal"]], shown["desired_goal"])
    assert reach["observation"] == list(range(width - 4))
    assert reach["desired_goal"] == throw["achieved_goal"]  # the ball
    grip = env.worlds.grip / 3.0 - 1.0
    torch.testing.assert_close(state[:, reach["achieved_goal"]], grip.float())


def test_the_stage_of_an_arm_of_three_links_follows_its_observation() -> None:
    env = make_env("robot_v1", num_links=3)
    reach, throw = env.stages()
    assert (len(reach["observation"]), len(throw["observation"])) == (14, 18)
    assert reach["achieved_goal"] == [6, 7]


@pytest.mark.parametrize("name", REACHES)
def test_a_reach_is_a_single_stage(name: str) -> None:
    with pytest.raises(ValueError, match=f"^{name} has no curriculum: it has one stage; choose a throwing"):
        make_env(name).stages()


@pytest.mark.parametrize("name", TASKS)
def test_all_goals_lie_in_the_box(name: str) -> None:
    env = make_env(name, num_envs=50)
    low, high = (torch.tensor(side) for side in env.goal_box())
    assert (low.tolist(), high.tolist()) == ([-1.0, -1.0], [1.0, 1.0])
    torch.manual_seed(0)
    steps = env.rollout(50, break_when_any_done=False)
    for key in ("desired_goal", "achieved_goal"):
        assert (steps[key] >= low - 0.01).all()
        assert (steps[key] <= high + 0.01).all()


@pytest.mark.parametrize("name", TASKS)
def test_regions_hold_the_goals_and_the_grips(name: str) -> None:
    env = make_env(name, num_envs=200, seed=1)
    assert list(env.regions()) == ["goals", "reach"]
    torch.manual_seed(0)
    shown = env.rollout(20, break_when_any_done=False)
    for key, points in (("goals", shown["desired_goal"]), ("reach", env.worlds.grip / 3.0 - 1.0)):
        low, high = (torch.tensor(side) for side in env.regions()[key])
        assert (points >= low - 1e-6).all()
        assert (points <= high + 1e-6).all()
        assert (high >= low).all()


def test_sigma_is_smaller_only_over_the_wall_with_a_held_ball() -> None:
    sigmas = {name: make_env(name).goal_sigma for name in TASKS}
    assert sigmas.pop("hand_wall_v0") == 0.1
    assert set(sigmas.values()) == {0.2}


@pytest.mark.parametrize("name", TASKS)
def test_episodes_of_reaches_start_near_their_goals(name: str) -> None:
    assert make_env(name).starts_near_goals == (name in REACHES)


def test_trails_are_those_of_the_balls() -> None:
    env = make_env("hand_v0", num_envs=2)
    env.reset()
    before = env.trail_points()
    assert torch.equal(before, env.worlds.ball)
    env.rand_step()
    assert not torch.equal(before, env.trail_points())


@pytest.mark.parametrize("dtype", ["float64", torch.float64])
def test_a_type_may_be_given_by_name(dtype: torch.dtype | str) -> None:
    assert make_env("hand_v0", dtype=dtype).reset()["state"].dtype == torch.float64


@pytest.mark.parametrize("dtype", ["int64", "nothing", torch.int64, 3])
def test_types_that_hold_no_fractions_are_refused(dtype: object) -> None:
    with pytest.raises(ValueError, match=f"dtype must be a floating-point type .* got {dtype!r}"):
        make_env("hand_v0", dtype=dtype)
