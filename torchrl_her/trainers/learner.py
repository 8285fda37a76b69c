"""The protocol of learners, and one that applies any TorchRL loss."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.objectives import LossModule
from torchrl.objectives.utils import TargetNetUpdater

from torchrl_her.trainers.runs import clip_by_run, keep_runs

_WEIGHT = "priority_weight"  # of importance sampling, as TorchRL's samplers and losses call it


class Learner(Protocol):
    """What the training loop needs of an algorithm: gradient steps of each run."""

    def update(self, rows: TensorDictBase, steps: int = 1, *, idle: Sequence[int] = ()) -> dict[str, Tensor]:
        """Learns from transitions (rows), and writes their new priorities into them.

        Args:
            rows: [R, S * B] of R runs; gradient step s takes the rows [:, s * B : (s + 1) * B].
            steps: S.
            idle: runs that do not learn; their rows are ignored.

        Returns:
            What was measured, [S, R] each.
        """
        ...


def check_steps(rows: TensorDictBase, steps: int) -> None:
    """Raises a ValueError if rows [R, n] are not a whole number of batches."""
    if steps < 1 or rows.shape[-1] % steps:
        raise ValueError(f"{rows.shape[-1]} rows cannot be shared out among {steps} gradient steps")


class LossLearner:
    """Gradient steps on any TorchRL loss module: backward, clipping, optimizer, target update.

    It trains several independent runs at once if the networks are stacked and the loss gives one number
    for each transition (``reduction="none"``). The sum of the runs' mean losses is differentiated, which
    gives each run the gradient that it would have alone.

    Args:
        loss: the outputs whose names begin with ``loss`` are summed; no two of them may train the same
            network.
        optimizer: over the loss module's parameters; must be elementwise, as Adam is, if there are several
            runs.
        target: moves the target networks; None for a loss without them.
        max_grad_norm: to which the gradients of each network of each run are clipped separately.
        runs: R.

    Example:
        >>> from torchrl_her import make_actor, make_critic, make_ddpg_loss, make_target_updater
        >>> loss = make_ddpg_loss(make_actor((9, 2), 3), make_critic((9, 2), 3))
        >>> target = make_target_updater(loss, tau=0.01, hard_interval=0)
        >>> learner = LossLearner(loss, torch.optim.Adam(loss.parameters()), target)
    """

    def __init__(
        self,
        loss: LossModule,
        optimizer: torch.optim.Optimizer,
        target: TargetNetUpdater | None = None,
        *,
        max_grad_norm: float = 3.0,
        runs: int = 1,
    ) -> None:
        self.loss, self.optimizer, self.target = loss, optimizer, target
        self.max_grad_norm, self.runs = max_grad_norm, runs
        self._networks = self._find_networks()

    def update(self, rows: TensorDictBase, steps: int = 1, *, idle: Sequence[int] = ()) -> dict[str, Tensor]:
        """Gradient steps of each run; see :class:`~torchrl_her.trainers.Learner`."""
        last = rows.ndim - 1
        check_steps(rows, steps)
        parts = rows.split(rows.shape[last] // steps, last)
        with keep_runs(self.loss, self.optimizer, idle, runs=self.runs):
            measured = [self._update(part) for part in parts]
        key = getattr(self.loss.tensor_keys, "priority", None)
        priorities = [] if key is None else [part.get(key, None) for part in parts]
        if priorities and priorities[0] is not None:
            rows.set(key, torch.cat(priorities, last))
        return {key: torch.stack([step[key] for step in measured]) for key in measured[0]}

    def _update(self, batch: TensorDictBase) -> dict[str, Tensor]:
        weight = batch.get(_WEIGHT, None)
        if weight is not None:
            # With reduction="mean" TorchRL divides by the sum of the weights, with "none" it does not.
            by_run = weight.reshape(self.runs, -1)
            batch.set(_WEIGHT, (by_run / by_run.mean(1, keepdim=True)).view_as(weight))
        output = self.loss(batch)
        losses = {
            key: value.reshape(self.runs, -1).mean(1)
            for key, value in output.items()
            if key.startswith("loss")
        }
        self.optimizer.zero_grad(set_to_none=True)
        torch.stack(list(losses.values())).sum().backward()
        for parameters in self._networks:
            self._clip(parameters)
        self.optimizer.step()
        if self.target is not None:
            self.target.step()
        return {key: value.detach() for key, value in losses.items()}

    def _clip(self, parameters: list[nn.Parameter]) -> None:
        if self.runs == 1:
            nn.utils.clip_grad_norm_(parameters, self.max_grad_norm)
        else:
            clip_by_run(parameters, self.max_grad_norm, runs=self.runs)

    def _find_networks(self) -> list[list[nn.Parameter]]:
        """The parameters of each network: the loss module's children that have any."""
        groups: dict[str, list[nn.Parameter]] = {}
        for name, parameter in self.loss.named_parameters():
            groups.setdefault(name.split(".")[0], []).append(parameter)
        return list(groups.values())
