"""Episodes that go on one step at a time."""

from __future__ import annotations

import torch

from torchrl_her_envs import make_env
from torchrl_her_envs.common.live import LiveEpisodes


def test_each_step_is_one_of_all_environments_and_the_end_of_an_episode_is_its_own() -> None:
    env = make_env("hand_reach", num_envs=2, seed=0)
    live = LiveEpisodes(env, lambda shown: shown.set("action", torch.zeros(2, 3)), size=32)
    live.start(seed=3)
    start = live.frame
    assert (live.step_count, live.running, live.achieved, live.worlds) == (0, [0, 1], 0, 2)
    env.worlds.joints[1] = env.worlds.ball[1]
    live.step()
    assert (live.step_count, live.running, live.achieved) == (1, [0], 1)
    assert not live.frame.equal(start)
    while live.running:
        live.step()
    assert (live.step_count, live.achieved) == (live.max_steps, 1)
    last = live.frame
    live.step()
    assert live.frame is last


def test_a_seed_says_which_goals_there_are_whatever_was_played_before() -> None:
    env = make_env("hand_reach", num_envs=3, seed=0)
    live = LiveEpisodes(env, env.rand_action, size=32)
    goals = []
    for steps in (0, 3, 40):
        live.start(seed=7)
        goals.append(live.desired_goal.clone())
        for _ in range(steps):
            live.step()
    assert goals[0].equal(goals[1])
    assert goals[0].equal(goals[2])
    live.start(seed=8)
    assert not live.desired_goal.equal(goals[0])


def test_only_the_environments_that_are_shown_count() -> None:
    env = make_env("hand_reach", num_envs=2, seed=0)
    live = LiveEpisodes(env, lambda shown: shown.set("action", torch.zeros(2, 3)), worlds=[0], size=32)
    live.start()
    env.worlds.joints[1] = env.worlds.ball[1]
    live.step()
    assert (live.worlds, live.achieved, live.running) == (1, 0, [0])
    assert live.frame.shape == (32, 32, 3)
