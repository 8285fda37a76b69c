"""The protocol of learners, and a learner for any TorchRL loss."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Protocol

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.objectives import HardUpdate, LossModule
from torchrl.objectives.utils import TargetNetUpdater

from torchrl_her.trainers.runs import clip_by_run, keep_runs, run_dims

WEIGHT = "priority_weight"  # key of importance weights in TorchRL's samplers and losses


class Learner(Protocol):
    """Protocol of an algorithm in the training loop: makes gradient steps for each run."""

    def update(self, rows: TensorDictBase, steps: int = 1, *, idle: Sequence[int] = ()) -> dict[str, Tensor]:
        """Learns from transitions (rows), and writes their new priorities into them.

        Args:
            rows: [R, S * B] of R runs; gradient step s takes the rows [:, s * B : (s + 1) * B].
            steps: S, the number of gradient steps.
            idle: runs that do not learn; their rows are ignored.

        Returns:
            The losses and other measurements, [S, R] each.
        """
        ...


def check_rows(rows: TensorDictBase, steps: int, runs: int) -> None:
    """Raises a ValueError if rows are not [R, n] (or [n] of one run), with a whole number of batches."""
    if rows.ndim not in (1, 2) or (rows.shape[0] if rows.ndim == 2 else 1) != runs:
        raise ValueError(f"rows of {runs} runs must be of shape [{runs}, n], got {list(rows.shape)}")
    if steps < 1 or rows.shape[-1] % steps:
        raise ValueError(f"steps must be at least 1 and divide {rows.shape[-1]} rows, got {steps}")


def check_idle(
    optimizer: torch.optim.Optimizer, target: TargetNetUpdater | None, idle: Sequence[int]
) -> None:
    """Refuses idle runs if the steps of all runs are counted together, which would change later steps.

    Raises:
        ValueError: the optimizer is a plain Adam, or the target update a plain HardUpdate.
    """
    remedies = {
        torch.optim.Adam: "trainers.RunsAdam(loss, lr=..., runs=R)",
        HardUpdate: "make_target_updater(loss, tau=0, hard_interval=..., runs=R)",
    }
    for part in (optimizer, target):
        if idle and type(part) in remedies:
            raise ValueError(
                f"runs {list(idle)} are idle, but {type(part).__name__} counts the steps of all runs "
                f"together: use torchrl_her.{remedies[type(part)]}"
            )


@contextmanager
def idle_runs(loss: LossModule, target: TargetNetUpdater | None, idle: Sequence[int]) -> Iterator[None]:
    """Marks in a loss and its target update, in the ``with`` block, the runs that do not learn."""
    parts: list[Any] = [part for part in (getattr(loss, "noise", None), target) if hasattr(part, "idle")]
    for part in parts:
        part.idle = tuple(idle)
    try:
        yield
    finally:
        for part in parts:
            part.idle = ()


class LossLearner:
    """Gradient steps on any TorchRL loss module: backward, clipping, optimizer, target update.

    It trains several independent runs at once if the networks are stacked and the loss gives one number
    for each transition (``reduction="none"``). The sum of the runs' mean losses is differentiated, which
    gives each run the gradient that it would have alone.

    Args:
        loss: loss module. Outputs whose names begin with ``loss`` are summed; no two of them may train the
            same network.
        optimizer: optimizer of the loss module's parameters; must be elementwise, as Adam is, if there are
            several runs, and a :class:`~torchrl_her.trainers.RunsAdam` if some runs may be idle.
        target: update of the target networks; None for a loss without them.
        max_grad_norm: norm to which the gradients are clipped, for each network of each run separately.
        runs: R, the number of independent runs.

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
        """Makes gradient steps for each run; see :class:`~torchrl_her.trainers.Learner`.

        Raises:
            ValueError: the rows are not of R runs or not a whole number of batches, or the loss does
                not give one number for each row.
        """
        check_rows(rows, steps, self.runs)
        last = rows.ndim - 1
        parts = rows.split(rows.shape[last] // steps, last)
        check_idle(self.optimizer, self.target, idle)
        keeping = keep_runs(self.loss, self.optimizer, idle, runs=self.runs)
        with keeping, idle_runs(self.loss, self.target, idle):
            measured = [self._update(part) for part in parts]
        key = getattr(self.loss.tensor_keys, "priority", None)
        priorities = [] if key is None else [part.get(key, None) for part in parts]
        if priorities and priorities[0] is not None:
            rows.set(key, torch.cat(priorities, last))
        return {key: torch.stack([step[key] for step in measured]) for key in measured[0]}

    def _update(self, batch: TensorDictBase) -> dict[str, Tensor]:
        weight = batch.get(WEIGHT, None)
        if weight is not None:
            # With reduction="mean" TorchRL divides by the sum of the weights, with "none" it does not.
            by_run = weight.reshape(self.runs, -1)
            batch.set(WEIGHT, (by_run / by_run.mean(1, keepdim=True)).view_as(weight))
        output = self.loss(batch)
        losses = {
            key: self._mean(key, value, batch) for key, value in output.items() if key.startswith("loss")
        }
        self.optimizer.zero_grad(set_to_none=True)
        torch.stack(list(losses.values())).sum().backward()
        for parameters, dim in self._networks:
            if self.runs == 1:
                nn.utils.clip_grad_norm_(parameters, self.max_grad_norm)
            else:
                clip_by_run(parameters, self.max_grad_norm, runs=self.runs, dim=dim)
        self.optimizer.step()
        if self.target is not None:
            self.target.step()
        return {key: value.detach() for key, value in losses.items()}

    def _mean(self, name: str, value: Tensor, batch: TensorDictBase) -> Tensor:
        """Returns the mean loss [R] of each run."""
        if self.runs > 1 and value.numel() != batch.numel():
            raise ValueError(
                f"with {self.runs} runs, {name} must have one number for each of {batch.numel()} rows "
                f'(reduction="none"), got a shape of {list(value.shape)}'
            )
        return value.reshape(self.runs, -1).mean(1)

    def _find_networks(self) -> list[tuple[list[nn.Parameter], int]]:
        """Returns the parameters of each network (child of the loss), and the runs' dimension in them."""
        groups: dict[str, list[nn.Parameter]] = {}
        dims, dim_of = run_dims(self.loss), {}
        for name, parameter in self.loss.named_parameters():
            network = name.split(".")[0]
            groups.setdefault(network, []).append(parameter)
            dim_of[network] = dims.get(name, 0)
        return [(parameters, dim_of[network]) for network, parameters in groups.items()]
