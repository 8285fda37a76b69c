"""The chain step by step, and as a task of stages."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDictBase

from torchrl_her_envs import Chain, ToyEnv

from .toy_envs import act, put


def test_transitions_differ_from_start_to_start_step_to_step_and_environment_to_environment() -> None:
    env = Chain(1000, 0.5, num_envs=200, seed=2)
    forward = []
    for _ in range(2):
        env.reset()
        put(env, place=[1] * 500 + [0] * 500)
        places = torch.stack([act(env, 1)["observation"].sum(-1) for _ in range(50)])
        forward.append(places.diff(dim=0) > 0)
    one, two = forward  # [49, 200]
    for a, b in ((one, two), (one[1:], one[:-1]), (one[:, 1:], one[:, :-1])):
        assert 0.46 < (a == b).double().mean() < 0.54  # 9,800 coins: eight standard deviations


def closed(after: TensorDictBase) -> int:
    """How many links are closed; they are the first ones."""
    links = after["observation"][0].tolist()
    count = links.count(1.0)
    assert links == [1.0] * count + [-1.0] * (len(links) - count)
    return count


def test_without_chance_actions_do_what_they_say() -> None:
    env = Chain(4, 1.0, max_steps=10)
    assert env.reset()["state"].tolist() == [[-1.0] * 4 + [1.0] * 4]
    steps = [act(env, action) for action in (0, 1, 1, 0, 1, 1, 1)]
    assert [closed(after) for after in steps] == [0, 1, 2, 1, 2, 3, 4]
    assert [after["reward"].item() for after in steps] == [-1.0] * 6 + [0.0]
    assert [after["terminated"].item() for after in steps] == [False] * 6 + [True]


def test_in_the_reset_state_form_every_mistake_leads_to_the_first_place() -> None:
    env = Chain(4, 1.0, reset_state=True)
    env.reset()
    steps = [act(env, action) for action in (1, 1, 0, 1)]
    assert [closed(after) for after in steps] == [1, 2, 0, 1]
    assert [after["truncated"].item() for after in steps] == [False, False, False, True]


@pytest.mark.parametrize("reset_state", [False, True])
def test_forward_arrives_as_often_as_appendix_c_says(reset_state: bool) -> None:
    env = Chain(3, 0.8, reset_state=reset_state, num_envs=8000, seed=4)
    env.reset()
    after = [act(env, 1) for _ in range(3)][-1]
    assert after["truncated"].all()
    arrived = after["terminated"].double().mean().item()
    assert abs(arrived - 0.512) < 0.028  # 0.8**3, within five standard deviations


@settings(max_examples=10, deadline=None)
@given(st.floats(0.05, 0.95), st.booleans(), st.integers(1, 8))
def test_steps_of_the_chain(probability: float, reset_state: bool, place: int) -> None:
    env = Chain(9, probability, reset_state=reset_state, num_envs=1000)
    env.reset()
    links = [1] * place + [0] * (9 - place)
    put(env, place=links)
    act(env, 1)
    places = env.world_state_dict()["place"].sum(-1)
    assert set(places.tolist()) == {place + 1, 0 if reset_state else place - 1}
    assert abs((places == place + 1).double().mean() - probability) < 0.08
    put(env, place=links)
    act(env, 0)
    assert set(env.world_state_dict()["place"].sum(-1).tolist()) == {0 if reset_state else place - 1}


def test_in_an_alternating_chain_odd_places_want_the_other_action() -> None:
    env = Chain(4, 1.0, alternating=True, reset_state=True, max_steps=10)
    env.reset()
    assert [closed(act(env, action)) for action in (1, 1, 1, 0, 1, 0)] == [1, 0, 1, 2, 3, 4]


def test_of_a_chain_of_stages_only_the_last_is_achieved() -> None:
    env = Chain(6, 1.0, stages=3)
    assert env.reset()["desired_goal"].tolist() == [[1.0, 1.0]]
    steps = [act(env, 1) for _ in range(6)]
    assert [after["achieved_goal"][0].tolist() for after in steps] == [[-1.0, -1.0]] * 4 + [
        [1.0, -1.0],
        [1.0, 1.0],
    ]
    assert [after["terminated"].item() for after in steps] == [False] * 5 + [True]


def test_each_part_of_a_chain_is_a_stage() -> None:
    env = Chain(6, 1.0, stages=3)
    stages = env.stages()
    assert [stage["name"] for stage in stages] == ["part 1", "part 2", "part 3"]
    assert [stage["observation"] for stage in stages] == [[0, 1], [0, 1, 2, 3], [0, 1, 2, 3, 4, 5]]
    assert [stage["achieved_goal"] for stage in stages] == [[0, 1], [2, 3], [4, 5]]
    assert all(stage["desired_goal"] == [6, 7] for stage in stages)
    assert [stage.get("threshold") for stage in stages] == [env.threshold, env.threshold, None]
    assert all(stage["instructive"] for stage in stages)
    state = env.reset()["state"]
    assert state[0, stages[0]["desired_goal"]].tolist() == [1.0, 1.0]
    assert len(Chain(6, 1.0).stages()) == 1


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Chain(0, 0.5), "length must be a whole number from 1 to 1048575, got 0"),
        (lambda: Chain(6, 0.5, stages=4), "stages must divide length=6, got 4"),
        (lambda: Chain(3, 0.5, stages=4), "stages must be a whole number from 1 to 3, got 4"),
        (lambda: Chain(3, 0.0), r"forward_probability must be in \(0, 1\], got 0.0"),
        (lambda: Chain(3, 1.1), r"forward_probability must be in \(0, 1\], got 1.1"),
        (lambda: Chain(3, float("nan")), r"forward_probability must be in \(0, 1\], got nan"),
        (lambda: Chain(3, "often"), r"forward_probability must be in \(0, 1\], got often"),
        (lambda: Chain(3, 0.5, alternating=1), "alternating must be True or False, got 1"),
        (lambda: Chain(3, 0.5, reset_state="no"), "reset_state must be True or False, got 'no'"),
    ],
)
def test_what_cannot_be_made(make: Callable[[], ToyEnv], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()
