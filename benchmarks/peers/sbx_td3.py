"""TD3 of SBX (Stable-Baselines in JAX), with the HER of Stable-Baselines3."""

from __future__ import annotations

from typing import ClassVar

import jax
from sbx import TD3
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from peers.baselines import Baseline


class SBXTD3(Baseline):
    """TD3 of SBX, whose DDPG does not support observations with goals."""

    name: ClassVar[str] = "SBX, TD3"
    differs: ClassVar[str] = (
        "two critics and smoothed targets; the actor moves every second step; no priorities, no clipping of "
        "gradients or targets; transitions are relabeled when they are drawn, once for all gradient steps of "
        "a call; its networks see the achieved goal, too."
    )
    algorithm: ClassVar[type[OffPolicyAlgorithm]] = TD3

    def wait(self) -> None:
        policy = self.model.policy
        jax.block_until_ready((policy.actor_state, policy.qf_state))
