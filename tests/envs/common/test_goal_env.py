"""What all environments with goals offer, and how they are found below transforms."""

from __future__ import annotations

import pytest
import torch
from torchrl.envs import StepCounter, TransformedEnv
from torchrl.envs.libs.gym import GymEnv

from torchrl_her_envs import GoalEnv, goal_env, make_env, task_names
from torchrl_her_envs.common.goal_env import choose_indices

from ..gym.walk import WALK

EVERY = [*task_names(), f"gym:{WALK}"]


@pytest.mark.parametrize("name", EVERY)
def test_it_is_found_below_transforms(name: str) -> None:
    env = make_env(name)
    once = TransformedEnv(env, StepCounter())
    twice = TransformedEnv(once, StepCounter(step_count_key="other"), auto_unwrap=False)
    assert all(goal_env(outer) is env for outer in (env, once, twice))


def test_an_environment_without_goals_is_refused() -> None:
    with pytest.raises(TypeError, match="expected an environment with goals, got GymEnv"):
        goal_env(GymEnv("CartPole-v1"))


@pytest.mark.parametrize("name", EVERY)
def test_every_environment_says_all_of_its_task(name: str) -> None:
    env = make_env(name, num_envs=2)
    assert env.task_name == name
    assert 0 < env.goal_sigma < 1
    assert isinstance(env.starts_near_goals, bool)
    width = env.observation_spec["desired_goal"].shape[-1]
    boxes = [*env.regions().values(), *([] if env.goal_box() is None else [env.goal_box()])]
    for low, high in boxes:
        assert (len(low), len(high)) == (width, width)
    assert bool(boxes) == (name not in {"bit_flip", "treasure_hunt", "chain", f"gym:{WALK}"})
    assert env.can_render == (name != f"gym:{WALK}")
    points = env.trail_points()
    assert points is None or len(points) == 2


@pytest.mark.parametrize("name", EVERY)
def test_pictures_are_given_or_refused_in_one_line(name: str) -> None:
    env = make_env(name, num_envs=2)
    env.reset()
    if env.can_render:
        number, height, width, colors = env.render([1, 0], size=32).shape
        assert (number, width, colors) == (2, 32, 3)
        assert 16 <= height <= 32
        assert env.render(1, size=32).dtype == torch.uint8
        return
    with pytest.raises(ValueError, match=r"pictures") as raised:
        env.render([1, 0], size=32)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("name", ["bit_flip", "treasure_hunt", f"gym:{WALK}"])
def test_tasks_without_a_curriculum_say_so(name: str) -> None:
    with pytest.raises(
        ValueError, match=f"^{name} has no curriculum: give its stages as curriculum=FILE.yaml$"
    ):
        make_env(name).stages()


KEYS = {"name", "observation", "achieved_goal", "desired_goal", "threshold", "instructive"}


@pytest.mark.parametrize(("name", "options"), [("hand_v1", {}), ("robot_v2", {}), ("chain", {"stages": 5})])
def test_stages_are_plain_data_that_index_the_state(name: str, options: dict[str, int]) -> None:
    env = make_env(name, **options)
    width = env.observation_spec["state"].shape[-1]
    *below, last = env.stages()
    assert all(isinstance(stage["threshold"], float) for stage in below)
    assert set(last) == KEYS - {"threshold"}  # its goals are the task's
    for stage in (*below, last):
        assert set(stage) | {"threshold"} == KEYS
        assert isinstance(stage["name"], str)
        assert isinstance(stage["instructive"], bool)
        for key in ("observation", "achieved_goal", "desired_goal"):
            assert all(type(index) is int and 0 <= index < width for index in stage[key])
        assert len(stage["achieved_goal"]) == len(stage["desired_goal"])


@pytest.mark.parametrize("name", EVERY)
def test_names_of_entries_lie_in_the_state(name: str) -> None:
    env = make_env(name)
    seen, goal = (env.observation_spec[key].shape[-1] for key in ("observation", "desired_goal"))
    names = env.state_names()
    assert names["observation"] + names["desired_goal"] == list(range(seen + goal))
    for places in names.values():
        assert places == sorted(set(places))
        assert set(places) <= set(range(seen + goal))


@pytest.mark.parametrize("name", ["hand_v2", "robot_v1", "hand_reach", "robot_reach"])
def test_entries_of_throwing_states_are_what_their_names_say(name: str) -> None:
    env = make_env(name, num_envs=3)
    state, names = env.reset()["state"], env.state_names()
    for own in ("grip", "ball"):
        meters = getattr(env.worlds, own)
        assert torch.equal(state[:, names[own]], (meters * (2.0 / env.world.size) - 1.0).float())
    assert env.task.effector in names
    if env.task.throws:
        assert torch.equal(state[:, names["hole"]], env.worlds.goal.float())
        for stage, parts in zip(
            env.stages(), ([env.task.effector], [env.task.effector, "ball", "ball_speed"]), strict=True
        ):
            assert stage["observation"] == [place for part in parts for place in names[part]]


def test_entries_of_a_chain_are_named_by_its_parts() -> None:
    names = make_env("chain", length=6, stages=3).state_names()
    assert (names["part_1"], names["part_3"], names["desired_goal"]) == ([0, 1], [4, 5], [6, 7])


def test_defaults_of_an_environment_that_says_nothing() -> None:
    class Silent(GoalEnv):
        # What has no default is not called here.
        compute_reward = compute_terminated = set_seeds = _reset = _step = _set_seed = None

    silent = Silent(batch_size=[1])
    assert (silent.task_name, silent.goal_sigma, silent.starts_near_goals) == ("Silent", 0.2, False)
    assert (silent.can_render, silent.goal_box(), silent.regions(), silent.trail_points()) == (
        False,
        None,
        {},
        None,
    )
    with pytest.raises(ValueError, match="Silent has no curriculum"):
        silent.stages()
    with pytest.raises(ValueError, match="Silent gives no pictures"):
        silent.render()


@pytest.mark.parametrize(
    ("worlds", "chosen"), [(None, [0, 1, 2]), (2, [2]), ((2, 0), [2, 0]), (range(2), [0, 1])]
)
def test_indices(worlds: object, chosen: list[int]) -> None:
    assert choose_indices(3, worlds) == chosen


@pytest.mark.parametrize("worlds", [3, -1, [0, 3], []])
def test_indices_that_there_are_not(worlds: object) -> None:
    with pytest.raises(ValueError, match="worlds must be one or more indices from 0 to 2, got"):
        choose_indices(3, worlds)
