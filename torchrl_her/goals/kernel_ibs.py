"""IBS without a grid: q* and q are kernel densities, for goals of more dimensions than a grid can hold."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from torchrl_her.checks import check_whole
from torchrl_her.goals.density import log_kernel_density
from torchrl_her.goals.grid import Numbers
from torchrl_her.goals.instructive import InstructiveWeights
from torchrl_her.goals.weights import GOLDEN, spread_evenly


class KernelInstructiveness(InstructiveWeights):
    """The weights of IBS, max(q* - q, floor), by kernel densities (thesis, equations 4.5, 4.9).

    q* is the kernel density of the real goals, and q the kernel density of the virtual goals that were
    written since the buffer was last emptied, with the same kernel. Weights are in units of the largest q*
    of a real goal. Sigma has the schedule of :class:`~torchrl_her.Instructiveness`. Both densities are
    smooth, so a virtual goal raises q around itself and not in a cell.

    Goals that are not finite have weight 0.

    Args:
        goals: [n, g], desired goals drawn from the task. If there are more than ``samples``, an evenly spread
            part of them is used.

    Keyword Args:
        sigma: the final standard deviation of the kernel, in the unit of the goals divided by ``scale``.
        scale: divisor of goals, one number or g of them, for goals whose coordinates have different units.
        samples: maximum number of real goals, and of virtual ones, from which densities are computed. The
            virtual ones are a part that is spread evenly over all that were written.
        log_target: maps goals [m, g] and a sigma to the logarithm of the density q* [m], in place of the
            kernel density of ``goals``.
        **options: ``start_factor``, ``decay``, ``subtract`` and ``floor`` (here a share of a real goal's
            largest q*) of :class:`~torchrl_her.goals.InstructiveWeights`.

    Attributes:
        written: number of virtual goals since the buffer was last emptied.

    Raises:
        ValueError: an option is out of its range, goals are not finite, or of another width than the real
            ones.

    Example:
        >>> real = torch.tensor([[1.0] * 15, [2.0] * 15])
        >>> weights = KernelInstructiveness(real, sigma=1.0)
        >>> weights(torch.cat([real, real + 3.0]))
        tensor([1.0000, 1.0000, 0.0253, 0.0020])
        >>> weights.update(real[:1])
        >>> weights(real).round(decimals=3)  # at the first goal q exceeds q*
        tensor([0.0020, 0.3940])
    """

    _real: Tensor
    _scale: Tensor
    _virtual: Tensor
    _keys: Tensor
    _peak: Tensor | None  # the logarithm of the largest q* of a real goal, computed when it is needed

    def __init__(
        self,
        goals: Tensor,
        *,
        sigma: float,
        scale: Numbers = 1.0,
        samples: int = 1_000,
        log_target: Callable[[Tensor, float], Tensor] | None = None,
        **options: Any,
    ) -> None:
        if goals.ndim != 2 or len(goals) == 0 or not goals.isfinite().all():
            raise ValueError(f"goals must be finite, [n, g] with n > 0, got a shape of {list(goals.shape)}")
        check_whole(samples=samples)
        g = goals.shape[1]
        factor = torch.as_tensor(scale, dtype=torch.float64).reshape(-1)
        if len(factor) not in (1, g) or not bool(((factor > 0) & factor.isfinite()).all()):
            raise ValueError(f"scale must be positive and finite, a scalar or of length {g}, got {scale}")
        self.samples, self.log_target = samples, log_target
        self._scale = factor.to(goals.device).expand(g)
        self._real = goals.detach()[spread_evenly(len(goals), samples, goals.device)].double()
        self.clear()
        super().__init__(sigma=sigma, **options)

    @property
    def divergence(self) -> float:
        """KL(q || q*) in nats of the two kernel densities at the final sigma, averaged over goals from q.

        It is 0 if virtual goals are distributed like the real ones; NaN before the first write.
        """
        if len(self._virtual) == 0:
            return math.nan
        generator = torch.Generator().manual_seed(0)  # the same goals in each call, on any device
        noise = torch.randn(self._virtual.shape, dtype=torch.float64, generator=generator)
        self._move(self._virtual.device)
        goals = self._virtual + self.final_sigma * self._scale * noise.to(self._virtual.device)
        logs = self._log_kernel(goals, self._virtual, self.final_sigma)
        return max(0.0, float((logs - self._log_q_star(goals, self.final_sigma)).mean()))

    def __call__(self, goals: Tensor) -> Tensor:
        if goals.numel() == 0:
            return super().__call__(goals)
        self._check(goals)
        self._move(goals.device)
        if self._peak is None:
            self._peak = self._log_q_star(self._real, self.sigma).max()
        weight = (self._log_q_star(goals, self.sigma) - self._peak).exp()
        if self.subtract and len(self._virtual) > 0:
            weight -= (self._log_kernel(goals, self._virtual, self.sigma) - self._peak).exp()
        dtype = goals.dtype if goals.is_floating_point() else torch.get_default_dtype()
        # Far from all real goals q* alone would be rounded to 0, and a transition there would get no goals.
        least = max(self.floor if self.subtract else 0.0, torch.finfo(dtype).tiny)
        return weight.clamp_min(least).nan_to_num(0.0).to(dtype)

    def update(self, goals: Tensor) -> None:
        """Adds virtual goals to q.

        Each goal gets a key, the fractional part of its index times the golden ratio, and goals with the
        least keys stay. Such keys are spread evenly over any range of indices, so the goals that stay are
        spread over all that were written so far.
        """
        if self.is_uniform and goals.shape[-1] != self._real.shape[1]:
            return  # a stage without IBS may have goals of another width
        self._check(goals)
        goals = goals.detach().reshape(-1, goals.shape[-1])
        goals = goals[goals.isfinite().all(-1)]
        number = torch.arange(self.written, self.written + len(goals), device=goals.device)
        self.written += len(goals)
        self._move(goals.device)
        keys = torch.cat([self._keys, (number.double() * GOLDEN).frac()])
        keys, order = keys.sort(stable=True)
        order = order[: self.samples]
        self._virtual, self._keys = torch.cat([self._virtual, goals.double()])[order], keys[: self.samples]

    def clear(self) -> None:
        self.written = 0
        self._virtual, self._keys = self._real[:0], self._real.new_empty(0)

    def state_dict(self) -> dict[str, Any]:
        state = {"written": self.written, "virtual": self._virtual.clone(), "keys": self._keys.clone()}
        return {**super().state_dict(), **state}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        super().load_state_dict(state)
        self._check(state["virtual"])
        self.written = state["written"]
        self._virtual, self._keys = (state[name].clone() for name in ("virtual", "keys"))

    def _set_sigma(self, sigma: float) -> None:
        super()._set_sigma(sigma)
        self._peak = None

    def _log_q_star(self, goals: Tensor, sigma: float) -> Tensor:
        if self.log_target is not None:
            flat = goals.reshape(-1, goals.shape[-1])
            return self.log_target(flat, sigma).double().view(goals.shape[:-1])
        return self._log_kernel(goals, self._real, sigma)

    def _log_kernel(self, goals: Tensor, samples: Tensor, sigma: float) -> Tensor:
        return log_kernel_density(goals, samples, sigma * self._scale)

    def _check(self, goals: Tensor) -> None:
        if goals.shape[-1] != self._real.shape[1]:
            raise ValueError(f"goals must have {self._real.shape[1]} numbers, got {goals.shape[-1]}")

    def _move(self, device: torch.device) -> None:
        """Moves all tensors to the device of the goals."""
        if self._real.device != device or self._virtual.device != device:
            self._real, self._scale = self._real.to(device), self._scale.to(device)
            self._virtual, self._keys = self._virtual.to(device), self._keys.to(device)
            self._peak = None
