"""Bit flipping: what happens step by step, and what hindsight makes of the useless action."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from torchrl_her_envs import BitFlip, ToyEnv

from .toy_envs import act, collect, put, random_actions, relabelled


def test_bits_are_flipped_one_after_the_other() -> None:
    env = BitFlip(3)
    env.reset()
    put(env, place=[0, 1, 0], goal=[1, 1, 1])
    after = act(env, 2)
    assert after["observation"].tolist() == [[0.0, 1.0, 1.0]]
    assert (after["reward"].item(), after["done"].item()) == (-1.0, False)
    after = act(env, 0)
    assert after["state"].tolist() == [[1.0, 1.0, 1.0, 1.0, 1.0, 1.0]]
    assert (after["reward"].item(), after["terminated"].item(), after["truncated"].item()) == (0, True, False)


def test_a_bit_that_is_flipped_twice_is_as_it_was() -> None:
    env = BitFlip(3)
    env.reset()
    put(env, place=[0, 1, 0], goal=[1, 1, 1])
    act(env, 1)
    after = act(env, 1)
    assert after["observation"].tolist() == [[0.0, 1.0, 0.0]]
    assert not after["done"].item()
    assert act(env, 1)["truncated"].item()  # the third of three steps


def test_success_at_the_last_step_is_terminated_and_truncated() -> None:
    env = BitFlip(2)
    env.reset()
    put(env, place=[0, 0], goal=[1, 1])
    act(env, 0)
    after = act(env, 1)
    assert after["terminated"].item()
    assert after["truncated"].item()


def test_the_useless_action_ends_the_episode_and_says_nothing_of_the_goal() -> None:
    env = BitFlip(4, useless_action=True, num_envs=3)
    assert env.action_spec.space.n == 5
    before = env.reset()
    after = act(env, 4, 0, 4)
    useless = torch.tensor([True, False, True])
    assert torch.equal(after["observation"][useless], before["observation"][useless])
    assert torch.equal(after["desired_goal"], before["desired_goal"])
    assert torch.equal(after["truncated"].squeeze(-1), useless)
    assert torch.equal(after["done"].squeeze(-1), useless | after["terminated"].squeeze(-1))
    assert not after["terminated"][useless].any()
    assert (after["reward"][useless] == -1).all()


@pytest.mark.parametrize("bits", [1, 2, 3, 127])
def test_starts_are_uniform_over_pairs_that_differ(bits: int) -> None:
    shown = BitFlip(bits, num_envs=8000, seed=3).reset()
    start, goal = shown["observation"].long(), shown["desired_goal"].long()
    if bits < 4:  # every pair of different values as often as every other
        value = 2 ** torch.arange(bits)
        pairs = (start @ value * 2**bits + goal @ value).bincount(minlength=4**bits)
        allowed = ~torch.eye(2**bits, dtype=torch.bool).flatten()
        expected = 8000 / allowed.sum()
        assert not pairs[~allowed].any()
        assert ((pairs[allowed] - expected).abs() < 5 * expected.sqrt()).all()
    for share in (start.double().mean(0), goal.double().mean(0)):
        assert ((share - 0.5).abs() < 0.03).all()  # five standard deviations


def test_hindsight_always_praises_the_useless_action_and_the_filter_forgets_that() -> None:
    env = BitFlip(5, useless_action=True, num_envs=20)
    steps = collect(env, random_actions(env, 30))

    def praised(**options: object) -> tuple[int, bool]:
        real, virtual = relabelled(env, steps, **options)
        assert (real["action"] == 5).any()
        useless = virtual[virtual["action"] == 5]
        return len(useless), bool((useless["next", "reward"] == 0).all())

    number, all_positive = praised()
    assert number > 50
    assert all_positive
    assert praised(filter_achieved=True)[0] == 0


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: BitFlip(0), "bits must be a whole number from 1 to 127, got 0"),
        (lambda: BitFlip(128), "bits must be a whole number from 1 to 127, got 128"),
        (lambda: BitFlip(2.5), "bits must be a whole number from 1 to 127, got 2.5"),
        (lambda: BitFlip(True), "bits must be a whole number from 1 to 127, got True"),
        (lambda: BitFlip(3, useless_action=3), "useless_action must be True or False, got 3"),
    ],
)
def test_what_cannot_be_made(make: Callable[[], ToyEnv], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()
