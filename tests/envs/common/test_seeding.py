"""Random numbers as a function of (seed, environment, episode)."""

from typing import Any

import numpy as np
import pytest
import torch
from scipy import stats

from torchrl_her_envs.common.seeding import as_seeds, env_keys, uniform


def first_episode(num_envs: int) -> torch.Tensor:
    return torch.zeros(num_envs, dtype=torch.int64)


def test_numbers_are_those_of_splitmix64() -> None:
    # the test vector that is published with the generator, for the seed 1234567
    published = [
        6457827717110365317,
        3203168211198807973,
        9817491932198370423,
        4593380528125082431,
        16408922859458223821,
    ]
    u = uniform(np.array([1234567], dtype=np.uint64), first_episode(1), 5)
    assert u.dtype == torch.float64
    assert u.tolist() == [[bits // 2**11 / 2**53 for bits in published]]


@pytest.mark.parametrize("axis", ["environments", "episodes", "numbers", "seeds"])
def test_uniform_along_every_axis(axis: str) -> None:
    n = 4096
    if axis == "environments":
        sample = uniform(env_keys(0, n), first_episode(n), 1)
    elif axis == "episodes":
        sample = uniform(env_keys(0, 1).repeat(n), torch.arange(n), 1)
    elif axis == "numbers":
        sample = uniform(env_keys(0, 16), first_episode(16), 256)
    else:
        sample = uniform(np.concatenate([env_keys(seed, 1) for seed in range(n)]), first_episode(n), 1)
    flat = sample.flatten().numpy()
    assert len(np.unique(flat)) == n
    assert stats.kstest(flat, "uniform").pvalue > 0.001


@pytest.mark.parametrize("axis", ["environments", "episodes", "numbers"])
def test_neighbors_are_uncorrelated(axis: str) -> None:
    n = 4096
    if axis == "environments":
        u = uniform(env_keys(0, n + 1), first_episode(n + 1), 1).flatten()
    elif axis == "episodes":
        u = uniform(env_keys(0, 1).repeat(n + 1), torch.arange(n + 1), 1).flatten()
    else:
        u = uniform(env_keys(0, n), first_episode(n), 2).flatten()
    assert abs(np.corrcoef(u[:-1], u[1:])[0, 1]) < 4 / np.sqrt(n)  # four standard deviations


@pytest.mark.parametrize("num_envs", [2, 17, 1000])
def test_keys_do_not_depend_on_the_number_of_environments(num_envs: int) -> None:
    assert (env_keys(7, num_envs) == env_keys(7, 1000)[:num_envs]).all()


def test_keys_differ_between_environments_and_seeds() -> None:
    keys = np.concatenate([env_keys(seed, 100) for seed in range(100)])
    assert keys.dtype == np.uint64
    assert len(np.unique(keys)) == 10_000


def test_each_row_depends_on_its_own_environment_and_episode_alone() -> None:
    keys, episodes = env_keys(3, 10), torch.arange(10) * 5
    everything = uniform(keys, episodes, 9)
    some = [7, 2, 4]
    assert torch.equal(uniform(keys[some], episodes[some], 9), everything[some])
    assert torch.equal(
        uniform(keys, episodes, 4), everything[:, :4]
    )  # more numbers leave the first as they are


def test_episodes_share_no_number() -> None:
    u = uniform(env_keys(0, 1).repeat(20), torch.arange(20), 256)
    assert len(u.unique()) == 20 * 256


@pytest.mark.parametrize("seed", [0, 2**63, 2**64 - 1])
def test_every_64_bit_seed_works(seed: int) -> None:
    assert len(np.unique(env_keys(seed, 3))) == 3


def test_no_environment_draws_nothing() -> None:
    assert uniform(env_keys(0, 4)[[]], torch.zeros(0, dtype=torch.int64), 3).shape == (0, 3)


def test_arrays_give_the_numbers_that_tensors_give() -> None:
    keys, episodes = env_keys(3, 4), np.array([0, 5, 5, 2**40])
    u = uniform(keys, episodes, 7)
    assert isinstance(u, np.ndarray)
    assert np.array_equal(u, uniform(keys, torch.from_numpy(episodes), 7).numpy())


def test_seeds_as_a_list() -> None:
    for seeds in (3, np.int64(3), [3], (np.uint8(3),), np.array([3])):
        assert as_seeds(seeds) == [3]
        assert type(as_seeds(seeds)[0]) is int


@pytest.mark.parametrize("seeds", [1.7, [1.7], [3, 1.0], np.array([1.7]), "7"])
def test_seeds_that_are_not_integers_are_refused(seeds: Any) -> None:
    with pytest.raises(TypeError, match="seed must be an integer or a sequence of integers, got "):
        as_seeds(seeds)
