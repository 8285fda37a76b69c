"""Arguments of a compiled update: settings, and addresses of transitions and random numbers."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.objectives import LossModule

from torchrl_her.native.job import STOCHASTIC, Algorithm, Layer, Structures
from torchrl_her.objectives.critics import action_key
from torchrl_her.replay_buffers.keys import under_next
from torchrl_her.replay_buffers.n_steps import STEPS_KEY
from torchrl_her.trainers.fusing import FusedLoss

# Has an entry in a forked process, which lacks OpenMP's threads and would hang if it started new ones.
_FORKED: list[bool] = []
os.register_at_fork(after_in_child=lambda: _FORKED.append(True))

# number of noise tensors of a step: the first is for next actions, the second for present ones
_DRAWS = {Algorithm.TD3: 1, Algorithm.SAC: 2, Algorithm.TQC: 2}


class FusedCall:
    """Arguments of one compiled update. Attributes keep the memory alive to which the arguments point.

    Args:
        loss: loss whose options are read anew for each update, since they may be scheduled.
        fused: algorithm of the loss, and names of its networks.
        kinds: the structures for the type of the weights.
        rows: [R, S * B] transitions of R runs.
        steps: S, the number of gradient steps.
        runs: R, the number of independent runs.
        actor: layers of the actor.

    Raises:
        ValueError: an entry has another width, a discrete action is out of range, or the loss drops more
            quantiles than there are.
    """

    def __init__(
        self,
        loss: LossModule,
        fused: FusedLoss,
        kinds: Structures,
        rows: TensorDictBase,
        steps: int,
        runs: int,
        actor: Sequence[Layer],
    ) -> None:
        self._loss, self._algorithm, self._kinds, self._runs = loss, fused.algorithm, kinds, runs
        self._dtype, outputs = kinds.dtype, actor[-1].outputs
        # Width of the action, or number of discrete actions.
        self._actions: int = outputs // 2 if fused.algorithm in STOCHASTIC else outputs
        count = rows.numel() // runs
        self.job = kinds.job()
        self._kept: list[Tensor] = []
        self.priorities = torch.zeros(runs, count, dtype=self._dtype)
        job = self.job
        job.algorithm, job.runs, job.rows, job.batch = fused.algorithm, runs, count, count // steps
        job.threads = 1 if _FORKED else max(1, min(runs, torch.get_num_threads()))
        job.actions = self._actions
        job.priorities = self._keep(self.priorities)
        self._read_settings()
        self._read_rows(rows, getattr(loss, fused.actor).in_keys, actor[0].inputs)

    def set_idle(self, idle: Sequence[int]) -> None:
        """Sets which runs do not learn."""
        flags = torch.zeros(self._runs, dtype=torch.uint8)
        flags[list(idle)] = 1
        self.job.idle = self._keep(flags)

    def draw_noise(self, steps: int) -> tuple[Tensor, ...]:
        """Draws the random numbers of some steps, in the order in which TorchRL's loss would draw them."""
        kinds = _DRAWS.get(self._algorithm, 0)
        if kinds == 0:
            return ()
        job, noise, some = self.job, self._loss.noise, self.job.target_critics
        drawn = torch.empty(kinds, steps, self._runs, job.batch, self._actions, dtype=self._dtype)
        critics = torch.empty(steps, self._runs, some, dtype=torch.int32)
        for step in range(steps):
            for kind in range(kinds):
                drawn[kind, step] = noise(drawn[kind, step])
                if kind == 0 and some:  # the next action comes first, then the critics that evaluate it
                    critics[step] = noise.subsets(some, self._loss.num_qvalue_nets)
        job.noise, job.own_noise, job.drawn = drawn[0].data_ptr(), drawn[-1].data_ptr(), critics.data_ptr()
        return drawn, critics

    def _keep(self, tensor: Tensor) -> int:
        """Returns the address of a tensor, and keeps the tensor alive as long as this object."""
        self._kept.append(tensor)
        return tensor.data_ptr()

    def _read_settings(self) -> None:
        job, loss, estimator = self.job, self._loss, self._loss.value_estimator
        job.gamma = float(estimator.gamma)
        job.least, job.greatest = getattr(estimator, "low", -math.inf), getattr(estimator, "high", math.inf)
        if (terms := getattr(loss, "terms", None)) is not None:
            job.penalty, job.saturation = terms.action_penalty, terms.saturation_penalty
        job.target_critics = getattr(loss, "target_critics", 0)
        if self._algorithm is Algorithm.TQC:
            dropped, quantiles = loss.top_quantiles_to_drop_per_net, loss.qvalue_network.module.outputs
            if not 0 <= dropped < quantiles:
                raise ValueError(
                    f"top_quantiles_to_drop_per_net must be from 0 to {quantiles - 1}, got {dropped}"
                )
            job.dropped = dropped * loss.num_qvalue_nets
        if self._algorithm is Algorithm.TD3:
            job.policy_noise, job.noise_limit = loss.target_noise, loss.target_noise_clip
            self._read_bounds(loss.min_action, loss.max_action)
        elif self._algorithm in STOCHASTIC:
            job.target_entropy = float(loss.target_entropy)
            bounds = loss.actor_network[1].distribution_kwargs
            self._read_bounds(bounds.get("low", -1.0), bounds.get("high", 1.0))

    def _read_bounds(self, low: Any, high: Any) -> None:
        self.job.low, self.job.high = (
            self._keep(torch.as_tensor(bound).to(self._dtype).expand(self._actions).contiguous())
            for bound in (low, high)
        )

    def _read_rows(self, rows: TensorDictBase, keys: Sequence[NestedKey], inputs: int) -> None:
        job, key = self.job, action_key(self._loss)
        job.entries = len(keys)
        job.seen, job.next_seen = (
            self._joined(rows, seen_keys, inputs) for seen_keys in (keys, [under_next(key) for key in keys])
        )
        action = rows.get(key)
        if self._algorithm is Algorithm.DQN:
            whole = not (action.is_floating_point() or action.dtype == torch.bool)
            if action.numel() != self.priorities.numel() or not whole:
                raise ValueError(
                    f"{key!r} must be the number of an action in each row, got {action.dtype} "
                    f"of shape {list(action.shape)}"
                )
            choice = action.reshape(-1).to(torch.int64).contiguous()
            if not 0 <= int(choice.min()) <= int(choice.max()) < self._actions:
                raise ValueError(
                    f"actions must be from 0 to {self._actions - 1}, got {choice.unique().tolist()}"
                )
            job.choice = self._keep(choice)
        else:
            job.action = self._entry(action, self._actions, key)
        job.reward = self._entry(rows.get(("next", "reward")), 1, ("next", "reward"))
        terminated = rows.get(("next", "terminated"), None)
        if terminated is None:  # TorchRL's targets then use done, too
            terminated = rows.get(("next", "done"))
        job.terminated = self._entry(terminated, 1, ("next", "terminated"), torch.bool)
        weight = rows.get("priority_weight", None)
        if weight is not None and self._loss.use_prioritized_weights in (True, "auto"):
            job.weight = self._entry(weight, 1, "priority_weight")
        span = rows.get(self._loss.value_estimator.tensor_keys.steps_to_next_obs, None)
        if span is not None:
            # The loss's tensor is used, not a number, so that powers are rounded as in TorchRL.
            discount = self._loss.value_estimator.gamma.to(span.device) ** span
            job.discount = self._entry(discount, 1, STEPS_KEY)

    def _joined(self, rows: TensorDictBase, keys: Sequence[NestedKey], inputs: int) -> Any:
        """Returns the addresses of the networks' inputs, which the compiled steps join."""
        values = [rows.get(key) for key in keys]
        width = sum(value.shape[-1] for value in values)
        if width != inputs:
            raise ValueError(f"{list(keys)} must have {inputs} columns together, got {width}")
        kind = self._kinds.entry
        entries = [
            kind(self._entry(value, value.shape[-1], key), value.shape[-1])
            for key, value in zip(keys, values, strict=True)
        ]
        return (kind * len(entries))(*entries)

    def _entry(self, value: Tensor, width: int, name: NestedKey, dtype: torch.dtype | None = None) -> int:
        """Returns the address of an entry [R, S * B, width], by default in the type of the weights."""
        if value.device.type != "cpu":
            raise ValueError(f"{name!r} must be on the CPU to be fused, got it on {value.device}")
        entry = value.to(dtype or self._dtype).contiguous()
        if entry.numel() != self.priorities.numel() * width:
            raise ValueError(f"{name!r} must have {width} columns, got a shape of {list(value.shape)}")
        return self._keep(entry)
