"""Ids that distinguish the environments of several collectors."""

from __future__ import annotations

import os
import secrets
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs.transforms import Transform

from torchrl_her.replay_buffers.keys import device_of


class EnvIds(Transform):
    """Gives each environment an id that no other environment has, in this process or another.

    Append it to environments whose collector gives batches in which an environment has no fixed place:
    :class:`~torchrl.collectors.MultiAsyncCollector` over batched environments, or
    :class:`~torchrl.collectors.MultiSyncCollector` with ``cat_results=-1``. It is also needed where
    environments are reset before their episodes end. :class:`~torchrl_her.HERWriter` finds the ids by
    itself, and does not store them.

    Ids are random: each process draws them when it first resets the environment. Results do not depend on
    their values.

    Args:
        key: key of the ids, in the root and under ``next``.

    Example:
        >>> from torchrl.envs import GymEnv, SerialEnv, TransformedEnv
        >>> env = TransformedEnv(SerialEnv(2, lambda: GymEnv("Pendulum-v1")), EnvIds())
        >>> ids = env.rollout(3)["env_ids"].squeeze(-1)
        >>> bool((ids[:, 0] == ids[:, 2]).all()), bool(ids[0, 0] == ids[1, 0])
        (True, False)
    """

    def __init__(self, key: NestedKey = "env_ids") -> None:
        super().__init__(in_keys=[], out_keys=[key])
        self._ids: Tensor | None = None
        self._process = 0  # process that drew the ids; a forked one draws new ids

    def _own_ids(self, tensordict: TensorDictBase) -> Tensor:
        shape = (*tensordict.batch_size, 1)
        if self._ids is None or self._ids.shape != shape or self._process != os.getpid():
            ids = torch.arange(torch.Size(shape).numel(), device=device_of(tensordict)).view(shape)
            # 62 random bits: two processes draw overlapping ranges with a probability of about 1e-15
            self._ids, self._process = ids + secrets.randbits(62), os.getpid()
        return self._ids.clone()  # a copy: collectors write into the entries of a reset in place

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return tensordict_reset.set(self.out_keys[0], self._own_ids(tensordict_reset))

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return next_tensordict.set(self.out_keys[0], self._own_ids(next_tensordict))

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Adds the spec of the ids."""
        shape = (*observation_spec.shape, 1)
        observation_spec[self.out_keys[0]] = Unbounded(
            shape=shape, dtype=torch.int64, device=observation_spec.device
        )
        return observation_spec

    def clone(self) -> EnvIds:
        """Returns another transform, with ids of its own."""
        out: EnvIds = super().clone()
        out._ids = None
        return out

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "_ids": None}  # a copy has other environments and draws new ids
