"""Ids of environments: unique, constant, and not to be overwritten."""

from __future__ import annotations

import copy

import torch
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.envs import SerialEnv, TransformedEnv, check_env_specs

from torchrl_her import EnvIds
from torchrl_her_envs import make_env


def make(num_envs: int = 3) -> TransformedEnv:
    return TransformedEnv(make_env("bit_flip", num_envs=num_envs), EnvIds())


def ids_of(env: TransformedEnv) -> Tensor:
    return env.rollout(4, break_when_any_done=False)["env_ids"]


def test_specs() -> None:
    check_env_specs(make())
    check_env_specs(SerialEnv(2, make))


def test_each_environment_keeps_an_id_that_no_other_has() -> None:
    one, other = make(), make()
    first, second, third = ids_of(one), ids_of(one), ids_of(other)
    assert (first.shape, first.dtype) == ((3, 4, 1), torch.int64)
    assert torch.equal(first, second)
    assert (first == first[:, :1]).all()
    assert len(torch.cat((first, third)).unique()) == 6


def test_a_copy_is_another_environment() -> None:
    env = make()
    own = ids_of(env)
    assert not torch.isin(ids_of(copy.deepcopy(env)), own).any()


def test_a_fork_is_another_environment() -> None:
    env = make()
    own = ids_of(env)
    env.transform._process += 1  # as if it had been copied by a fork
    assert not torch.isin(ids_of(env), own).any()


def test_a_collector_that_is_reset_does_not_overwrite_them() -> None:
    collector = Collector(make(), frames_per_batch=12, total_frames=48)
    batches = iter(collector)
    first = next(batches)["env_ids"].clone()
    collector.reset()
    assert torch.equal(next(batches)["env_ids"], first)
    collector.shutdown()


def test_a_clone_has_ids_of_its_own() -> None:
    env = make()
    own = ids_of(env)
    other = TransformedEnv(make_env("bit_flip", num_envs=3), env.transform.clone())
    assert not torch.isin(ids_of(other), own).any()
