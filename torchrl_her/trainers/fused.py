"""Gradient steps in C++: the results of TorchRL's losses in a fraction of the time.

The learner works on the weights of the loss module, its target networks and its optimizer. So these can be
saved, loaded and used as always.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence
from functools import cache
from typing import Any, Literal, get_args

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives import HardUpdate, LossModule
from torchrl.objectives.common import AUTO_LOSS_MASK_KEYS
from torchrl.objectives.utils import TargetNetUpdater

from torchrl_her.native.job import Layer, Norm, structures
from torchrl_her.native.steps import load_steps
from torchrl_her.trainers.fused_call import FusedCall
from torchrl_her.trainers.fused_weights import FusedWeights
from torchrl_her.trainers.fusing import FUSED, is_plain_adam, layers_of, network_of, why_not_fused
from torchrl_her.trainers.learner import check_idle, check_rows, idle_runs

MatmulDtype = Literal["float32", "bfloat16"]


class FusedLearner:
    """A :class:`~torchrl_her.trainers.Learner` for this library's losses of DDPG, TD3, SAC, TQC and DQN.

    All gradient steps of an update are one call of a program in C++, which does everything: losses,
    gradients, clipping, Adam and target updates. The program is compiled at first use, which takes some
    seconds, and kept for later (see :func:`~torchrl_her.native.load_steps`). Several runs are shared out
    among the threads that torch may use (``torch.set_num_threads``).

    Args:
        loss: as :func:`~torchrl_her.make_ddpg_loss`, :func:`~torchrl_her.objectives.make_td3_loss`,
            :func:`~torchrl_her.objectives.make_sac_loss`, :func:`~torchrl_her.objectives.make_tqc_loss` or
            :func:`~torchrl_her.objectives.make_dqn_loss` makes it, with networks of this library in float32
            or float64, on the CPU.
        optimizer: a plain ``torch.optim.Adam`` over the loss module's parameters.
        target: update of the loss's target networks.
        max_grad_norm: norm to which the gradients of each network of each run are clipped separately; all
            critics count as one network.
        matmul_dtype: the type of the numbers that are multiplied between hidden layers of at least 32 units.
            ``"bfloat16"`` makes a step of 3 x 256 units in two thirds of the time on processors with
            AVX512-BF16, and takes longer on others. It needs weights in float32. Sums, weights and Adam's
            moments stay float32, and so do the products of the first and the last layer. The action, which
            a critic takes in at its second layer, is rounded there. Numbers in bfloat16 have three
            significant digits (Kalamkar et al., 2019), so results agree with TorchRL's losses to about
            a hundredth.

    The learner keeps references to the weights: make it after moving the loss to its device and type.
    Entries of the rows are cast to that type, so rewards may be float64 beside networks in float32. Rows may
    span several steps (``steps_to_next_obs``, see :class:`~torchrl_her.objectives.ClampedTD0`).

    Raises:
        ValueError: the fused steps do not support the loss, its targets or the optimizer, see
            :func:`~torchrl_her.trainers.why_not_fused`: use :class:`~torchrl_her.LossLearner`. Or
            ``matmul_dtype`` does not suit these weights.
        CannotCompile: there is no C++ compiler, and no library in a wheel.

    Example:
        >>> from torchrl.objectives import SoftUpdate
        >>> from torchrl_her import make_actor, make_critic, make_ddpg_loss
        >>> loss = make_ddpg_loss(make_actor((9, 2), 3), make_critic((9, 2), 3))
        >>> learner = FusedLearner(loss, torch.optim.Adam(loss.parameters()), SoftUpdate(loss, tau=0.01))
    """

    def __init__(
        self,
        loss: LossModule,
        optimizer: torch.optim.Optimizer,
        target: TargetNetUpdater,
        *,
        max_grad_norm: float = 3.0,
        matmul_dtype: MatmulDtype = "float32",
    ) -> None:
        self.loss, self.optimizer, self.target, self.max_grad_norm = loss, optimizer, target, max_grad_norm
        reason = why_not_fused(loss, target)
        if reason is not None:
            raise ValueError(f"these gradient steps cannot be fused: {reason}; use LossLearner")
        self._check_adam(loss)
        self._fused, dtype = FUSED[type(loss)], next(iter(loss.parameters())).dtype
        if matmul_dtype not in get_args(MatmulDtype):
            known = ", ".join(get_args(MatmulDtype))
            raise ValueError(f"matmul_dtype must be one of {known}, got {matmul_dtype!r}")
        if matmul_dtype == "bfloat16" and dtype != torch.float32:
            raise ValueError(f"matmul_dtype='bfloat16' needs weights in torch.float32, got {dtype}")
        self._matmul_dtype = matmul_dtype
        self._steps, self._kinds = load_steps(dtype), structures(dtype)
        self._weights = FusedWeights(loss, optimizer, self._kinds)
        self._actor, self._critic = self._layers(self._fused.actor), self._layers(self._fused.critic)
        self.runs: int = network_of(getattr(loss, self._fused.actor)).runs  # type: ignore[assignment]

    @property
    def tau(self) -> float:
        """Fraction of the online weights in a soft update; 0 if targets are copied (``HardUpdate``)."""
        return 0.0 if isinstance(self.target, HardUpdate) else 1.0 - float(self.target.eps)

    @tau.setter
    def tau(self, tau: float) -> None:
        if isinstance(self.target, HardUpdate):
            raise ValueError(f"tau must not be set where targets are copied by a HardUpdate, got {tau}")
        self.target.eps = 1.0 - tau

    @torch.no_grad()
    def update(self, rows: TensorDictBase, steps: int = 1, *, idle: Sequence[int] = ()) -> dict[str, Tensor]:
        """Makes gradient steps for each run; see :class:`~torchrl_her.trainers.Learner`.

        Raises:
            ValueError: the rows are not of R runs, not a whole number of batches, not on the CPU, have
                a mask of TorchRL's losses or do not match the networks; a batch of one row is to be
                normalized; or the loss or its optimizer has changed to one that is not supported.
        """
        check_rows(rows, steps, self.runs)
        self._check(rows, steps)
        check_idle(self.optimizer, self.target, idle)
        call = self._call(rows, steps)
        call.set_idle(idle)
        with idle_runs(self.loss, self.target, idle):
            if isinstance(self.target, HardUpdate):  # a hard update copies weights after some steps only
                losses = []
                for step in range(steps):
                    losses.append(self._run(call, step, 1))
                    self.target.step()
            else:
                losses = [self._run(call, 0, steps)]
        rows.set(self.loss.tensor_keys.priority, call.priorities.view(rows.batch_size))
        return dict(zip(self._fused.losses, torch.cat(losses, 1), strict=False))

    def _call(self, rows: TensorDictBase, steps: int) -> FusedCall:
        """Prepares the arguments of an update, except for its steps."""
        call = FusedCall(self.loss, self._fused, self._kinds, rows, steps, self.runs, self._actor)
        job, weights = call.job, self._weights
        job.actor, job.actor_layers, job.actor_tensors = self._actor, len(self._actor), weights.actor_tensors
        job.critic, job.critic_layers = self._critic, len(self._critic)
        job.critics, job.critic_tensors = weights.critics, weights.critic_tensors
        job.tensors = weights.table()
        job.max_norm, job.tau, job.bfloat16 = self.max_grad_norm, self.tau, self._matmul_dtype == "bfloat16"
        return call

    def _run(self, call: FusedCall, first: int, steps: int) -> Tensor:
        """Makes the gradient steps from number ``first`` on, and returns their losses, [3, steps, R]."""
        losses = torch.zeros(3, steps, self.runs, dtype=self._kinds.dtype)
        counts = self._weights.counts
        noise, adam = call.draw_noise(steps), self._adam(steps, counts)  # memory that the job points to
        job = call.job
        job.counts = len(counts)
        job.first_step, job.steps, job.losses, job.adam = first, steps, losses.data_ptr(), adam
        self._steps(ctypes.addressof(job))
        del noise
        return losses

    def _adam(self, steps: int, counts: Sequence[float]) -> Any:
        """Returns the numbers [R, S] of Adam's next S steps of each run, such as bias corrections."""
        (group,) = self.optimizer.param_groups
        rate, (beta1, beta2), kind = float(group["lr"]), group["betas"], self._kinds.adam

        @cache  # most runs have made the same number of steps
        def numbers(count: float) -> list[Any]:
            return [
                kind(
                    *bias_corrections(count + step, rate, (beta1, beta2)),
                    beta2,
                    1 - beta1,
                    1 - beta2,
                    group["eps"],
                )
                for step in range(1, steps + 1)
            ]

        # The optimizer's step() would set this, and schedulers of learning rates check it.
        self.optimizer._opt_called = True  # type: ignore[attr-defined]
        return (kind * (steps * self.runs))(
            *(entry for run in range(self.runs) for entry in numbers(counts[run % len(counts)]))
        )

    def _layers(self, name: str | None) -> Any:
        layers = [] if name is None else layers_of(network_of(getattr(self.loss, name)))
        assert layers is not None  # checked by why_not_fused
        return (Layer * len(layers))(*layers)

    def _check(self, rows: TensorDictBase, steps: int) -> None:
        """Raises an error if the loss or the optimizer now has settings that fused steps do not support."""
        if rows.numel() == steps * self.runs and any(layer.norm == Norm.BATCHNORM for layer in self._critic):
            raise ValueError("batches must have at least 2 rows for batch normalization, got 1")
        if self.loss.reduction not in ("mean", "none"):
            raise ValueError(f"reduction={self.loss.reduction!r} cannot be fused: use LossLearner")
        if not all(parameter.requires_grad for parameter in self._weights.parameters):
            raise ValueError("parameters were frozen, but a fused step trains all of them: use LossLearner")
        mask_key = self.loss.loss_mask_key
        for key in AUTO_LOSS_MASK_KEYS if mask_key == "auto" else () if mask_key is None else (mask_key,):
            if rows.get(key, None) is not None:
                raise ValueError(
                    f"a fused step learns from all rows, but {key!r} masks some: use LossLearner, or set "
                    "loss.loss_mask_key = None"
                )
        self._check_adam(None)

    def _check_adam(self, loss: LossModule | None) -> None:
        if not is_plain_adam(self.optimizer, loss):
            raise ValueError(
                "only a plain torch.optim.Adam can be fused, with one group of exactly the loss's "
                f"parameters and without hooks, got {self.optimizer}"
            )


def bias_corrections(count: float, learning_rate: float, betas: tuple[float, float]) -> tuple[float, float]:
    """Returns Adam's step size at step number ``count``, and the divisor of the root of its second moment.

    Example:
        >>> [round(number, 6) for number in bias_corrections(1, 0.001, (0.9, 0.999))]
        [0.01, 0.031623]
    """
    return learning_rate / (1.0 - betas[0] ** count), math.sqrt(1.0 - betas[1] ** count)
