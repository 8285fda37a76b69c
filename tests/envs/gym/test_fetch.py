"""The Fetch tasks' names and stages are those of what gymnasium-robotics shows."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from torchrl_her import Curriculum, CurriculumStage
from torchrl_her_envs import make_gym_env, record_episodes
from torchrl_her_envs.common.rendering.video import write_video
from torchrl_her_envs.gym.check import make_one
from torchrl_her_envs.gym.fetch import fetch_names, fetch_stages
from torchrl_her_envs.gym.from_gym import GymGoalEnv

from ...forks import fork

OBJECTS = ("FetchPush-v4", "FetchSlide-v4", "FetchPickAndPlace-v4")


@pytest.fixture
def env(request: pytest.FixtureRequest) -> Iterator[GymGoalEnv]:
    pytest.importorskip("gymnasium_robotics")
    made = make_gym_env(request.param, num_envs=2, seed=3)
    yield made
    made.close()


@pytest.mark.parametrize("env", ["FetchReach-v4", "FetchPush-v4", "FetchPickAndPlace-v4"], indirect=True)
def test_names_are_of_what_they_say(env: GymGoalEnv) -> None:
    def part(name: str) -> torch.Tensor:
        return state[:, env.state_names()[name]]

    rollout = env.rollout(5)
    states = torch.cat((rollout["observation"], rollout["desired_goal"]), -1)
    state, before = states[:, -1], states[:, -2]
    last = rollout[:, -1]
    torch.testing.assert_close(part("place"), last["desired_goal"])
    moved = "grip" if "Reach" in env.task_name else "object"
    torch.testing.assert_close(part(moved), last["achieved_goal"])
    way = part("grip") - before[:, env.state_names()["grip"]]
    assert bool((way.sign() == part("grip_speed").sign())[way.abs() > 1e-3].all())
    assert sorted(index for name in fetch_names(env.task_name[4:]) for index in env.state_names()[name]) == [
        *range(states.shape[-1])
    ]
    if moved == "object":
        torch.testing.assert_close(part("object_from_grip"), part("object") - part("grip"))


@pytest.mark.parametrize("env", ["FetchPush-v4"], indirect=True)
def test_inputs_keep_their_meaning_from_stage_to_stage(env: GymGoalEnv) -> None:
    stages = [CurriculumStage(**stage) for stage in env.stages()]
    curriculum = Curriculum(stages, state_width=28, names=env.state_names())
    reach, move = curriculum.stages
    assert (*reach.observation, *reach.desired_goal) == move.observation[: curriculum.first_inputs]
    assert sorted((*move.observation, *move.desired_goal)) == [*range(28)]


@pytest.mark.parametrize("id", OBJECTS)
def test_the_object_is_reached_before_it_is_moved(id: str) -> None:
    reach, move = fetch_stages(id)
    assert (reach["achieved_goal"], reach["desired_goal"]) == ("grip", "object")
    assert (move["achieved_goal"], move["desired_goal"]) == ("object", "place")
    assert fetch_stages(id.replace("-v4", "Dense-v2")) == [reach, move]


@pytest.mark.parametrize("env", ["FetchPickAndPlace-v4"], indirect=True)
@pytest.mark.parametrize("fingers", [-1.0, 1.0], ids=["closed", "open"])
def test_what_is_picked_up_is_reached_with_open_fingers_only(env: GymGoalEnv, fingers: float) -> None:
    threshold, nearest = fetch_stages("FetchPickAndPlace-v4")[0]["threshold"], []
    shown = env.reset()
    for step in range(25):  # above the block, then down
        way = shown["observation"][:, 6:9] + torch.tensor([0.0, 0.0, 0.1 if step < 10 else 0.0])
        action = torch.cat(((10 * way).clamp(-1, 1), torch.full((2, 1), fingers)), -1)
        shown = env.step(shown.set("action", action))["next"]
        nearest.append(shown["observation"][:, 6:9].norm(dim=-1))
    reached = torch.stack(nearest).amin(0) < threshold
    assert reached.tolist() == [fingers > 0] * 2


def test_to_reach_is_a_single_stage() -> None:
    (stage,) = fetch_stages("FetchReach-v4")
    assert (stage["achieved_goal"], stage["desired_goal"]) == ("grip", "place")


@pytest.mark.parametrize("id", ["FetchPushFar-v4", "MyFetchPush-v4", "HandReach-v2", "FetchPush"])
def test_other_environments_have_none(id: str) -> None:
    assert fetch_stages(id) == []
    assert fetch_names(id) == {}


def test_films_without_a_display(tmp_path: Path) -> None:
    pytest.importorskip("gymnasium_robotics")
    env = make_gym_env("FetchReach-v4", num_envs=2, seed=3, max_steps=3, pictures=True)
    try:
        frames = record_episodes(env, env.rand_action, size=64, hold=0)
    except ValueError as error:
        pytest.skip(str(error))
    finally:
        env.close()
    assert len(frames) == 4
    assert frames[0].shape == (64, 128, 3)
    assert frames[0].float().std() > 20  # there is something to see
    assert write_video(frames, tmp_path / "film.gif").stat().st_size > 1_000


def test_nothing_is_printed_when_they_are_made(tmp_path: Path) -> None:
    process = fork(_make_one, tmp_path / "printed")
    process.join()
    assert process.exitcode == 0
    assert (tmp_path / "printed").read_text() == ""


def _make_one(printed: Path) -> None:
    with open(printed, "w") as file:
        for output in (1, 2):
            os.dup2(file.fileno(), output)
    make_one("FetchReach-v4", None, {}).close()
