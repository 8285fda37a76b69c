"""Random numbers that depend on nothing but seed, environment and episode.

An environment must start in the same way alone and in a batch of a thousand, whatever the others do. A
generator with a state cannot give that; a hash of a counter can.
"""

from __future__ import annotations

import operator
from collections.abc import Sequence
from numbers import Integral
from typing import overload

import numpy as np
import torch
from torch import Tensor

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)


def _mix(z: np.ndarray) -> np.ndarray:
    """Computes the output function of SplitMix64 (Steele, Lea and Flood, 2014)."""
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


def env_keys(seed: int, num_envs: int) -> np.ndarray:
    """Returns a 64-bit key for each environment of a batch.

    Args:
        seed: any non-negative integer below 2**64.
        num_envs: number of environments.

    Returns:
        Array [num_envs] of uint64. Environment k has the same key in every batch with this seed.

    Example:
        >>> bool((env_keys(3, 2) == env_keys(3, 5)[:2]).all())
        True
    """
    base = _mix(np.array([seed], dtype=np.uint64) + _GOLDEN)
    return _mix(base + np.arange(1, num_envs + 1, dtype=np.uint64) * _GOLDEN)


def block_keys(seeds: Sequence[int], num_envs: int) -> np.ndarray:
    """Returns a key for each environment of a batch of R equal blocks, each as if it were alone.

    Args:
        seeds: R seeds.
        num_envs: number of environments in all.

    Raises:
        ValueError: the environments cannot be shared out among R blocks, or a seed is out of range.

    Example:
        >>> bool((block_keys([3, 4], 4)[2:] == env_keys(4, 2)).all())
        True
    """
    if not seeds or num_envs % len(seeds):
        raise ValueError(f"{num_envs} environments cannot be shared out among {len(seeds)} seeds")
    for seed in seeds:
        if not 0 <= seed < 1 << 64:
            raise ValueError(f"a seed must be at least 0 and below 2**64, got {seed}")
    return np.concatenate([env_keys(seed, num_envs // len(seeds)) for seed in seeds])


def as_seeds(seed: int | Sequence[int]) -> list[int]:
    """Returns one or several seeds as a list.

    Raises:
        TypeError: a seed is not an integer.

    Example:
        >>> as_seeds(3), as_seeds([3, 4])
        ([3], [3, 4])
    """
    if isinstance(seed, int | Integral):
        return [int(seed)]
    try:
        return [operator.index(value) for value in seed]
    except TypeError:
        raise TypeError(f"seed must be an integer or a sequence of integers, got {seed!r}") from None


@overload
def uniform(keys: np.ndarray, episodes: np.ndarray, count: int) -> np.ndarray: ...


@overload
def uniform(keys: np.ndarray, episodes: Tensor, count: int) -> Tensor: ...


def uniform(keys: np.ndarray, episodes: np.ndarray | Tensor, count: int) -> np.ndarray | Tensor:
    """Draws uniform numbers in [0, 1) for given episodes of given environments.

    Args:
        keys: [M] uint64, from :func:`env_keys`.
        episodes: [M] int64, the number of the episode in its environment.
        count: how many numbers an episode needs, at most 256.

    Returns:
        The numbers [M, count] in float64: an array or a tensor, as ``episodes`` is.

    Example:
        >>> u = uniform(env_keys(0, 2), torch.tensor([0, 0]), 3)
        >>> u.shape, bool(((u >= 0) & (u < 1)).all())
        (torch.Size([2, 3]), True)
    """
    if isinstance(episodes, Tensor):
        return torch.from_numpy(uniform(keys, episodes.numpy(), count))
    first = episodes.astype(np.uint64) * np.uint64(256)
    counter = first[:, None] + np.arange(1, count + 1, dtype=np.uint64)
    bits = _mix(keys[:, None] + counter * _GOLDEN)
    return (bits >> np.uint64(11)).astype(np.float64) * 2.0**-53
