"""A puck with momentum, whose episodes go on at its goal."""

from __future__ import annotations

import torch
from torchrl.envs.utils import check_env_specs

from torchrl_her_envs import make_env
from torchrl_her_envs.toy.puck import Puck


def test_specs_hold() -> None:
    check_env_specs(Puck(num_envs=3, seed=0))


def test_it_slides_on_by_itself_and_stops_at_the_edge() -> None:
    env = Puck(num_envs=1)
    shown = env.reset()
    env.place, env.velocity = torch.tensor([[0.5, 0.0]]), torch.tensor([[0.3, 0.1]])
    for place, velocity in (([0.8, 0.1], [0.3, 0.1]), ([1.0, 0.2], [0.0, 0.1]), ([1.0, 0.3], [0.0, 0.1])):
        shown = env.step(shown.set("action", torch.zeros(1, 2)))["next"]
        torch.testing.assert_close(shown["observation"], torch.tensor([place + velocity]))


def test_nothing_ends_an_episode_at_its_goal() -> None:
    env = make_env("torchrl_her_envs.toy.puck:Puck", num_envs=4, seed=[1, 2], termination="never")
    shown = env.reset()
    inner = env._envs[0]
    inner.place, inner.velocity = inner.goal.clone(), torch.zeros(4, 2)
    after = env.step(shown.set("action", torch.zeros(4, 2)))["next"]
    assert after["reward"].eq(0).all()
    assert not after["done"].any()


def test_a_block_does_not_depend_on_the_others() -> None:
    both, alone = Puck(num_envs=4, seed=[7, 8]), Puck(num_envs=2, seed=[8])
    first, second = both.reset(), alone.reset()
    assert torch.equal(first["observation"][2:], second["observation"])
    both.reset(first.set("_reset", torch.tensor([[True], [False], [False], [False]])))
    assert torch.equal(both.place[2:], alone.place)
    both.reset(first.set("_reset", torch.tensor([[False], [False], [True], [False]])))
    alone.reset(second.set("_reset", torch.tensor([[True], [False]])))
    assert torch.equal(both.place[2:], alone.place)
    assert torch.equal(both.goal[2:], alone.goal)
