"""Weights that prefer rare goals: those with the fewest others around them."""

from __future__ import annotations

import math
from typing import Any, Literal, NamedTuple, get_args

import torch
from torch import Tensor

from torchrl_her.checks import check_whole
from torchrl_her.goals.density import goal_scale, log_kernel_density, log_neighbor_density
from torchrl_her.goals.grid import Numbers
from torchrl_her.goals.weights import GoalWeights, normalized_weights, spread_evenly

Estimator = Literal["kernel", "neighbors"]

_LEVEL = 128  # number of samples; the median of their densities is the density of an ordinary goal
_LEAST_DISTANCE = 1e-3  # distance in standard deviations below which goals count as equal
_SHARPEST = 3.0  # number of dimensions above which the default of sharpness falls


class RareGoals(GoalWeights):
    """Weights goals by the inverse of their density among the goals that were written most recently.

    Goals at the edge of the reached region are then drawn more often than goals in its middle. MEGA
    (Pitis et al., Maximum entropy gain exploration for long horizon multi-goal reinforcement learning, 2020)
    sets goals of the least density for the agent to pursue; here the same preference chooses goals to
    relabel with.

    Goals are divided by the standard deviations of the remembered goals, so coordinates of different units
    count equally. While no goal is remembered, all weights are 1; goals that are not finite have weight 0.

    Keyword Args:
        estimator: ``"kernel"`` for a Gaussian kernel around each goal, for a few dimensions; ``"neighbors"``
            for the distance to the k-th nearest goal, for many.
        sigma: width of the kernel, in standard deviations of the goals; or one for each coordinate.
        k: with ``"neighbors"``, the distance to the k-th nearest goal gives the density.
        sharpness: weights are ``density ** -sharpness``; None for 1 up to three dimensions and 3 / g beyond,
            since the same ratio of distances is a far greater ratio of densities there.
        limit: a goal's weight is at most ``limit`` times the weight at median density, and at least that
            weight divided by ``limit``.
        memory: number of the newest goals that are remembered.
        samples: number of remembered goals, spread evenly over the memory, that densities are estimated from.

    Attributes:
        goals: [n, g], the remembered goals, in no particular order; None if there are none.

    Raises:
        ValueError: an option is out of its range, or goals have another width than those remembered.

    Example:
        >>> weights = RareGoals(estimator="neighbors", k=2)
        >>> weights.update(torch.tensor([[0.0], [1.0], [2.0], [9.0]]))
        >>> weights(torch.tensor([[0.5], [9.0]]))  # the second nearest goals are at distances 0.5 and 7
        tensor([0.0714, 1.0000])
    """

    def __init__(
        self,
        *,
        estimator: Estimator = "kernel",
        sigma: Numbers = 0.2,
        k: int = 10,
        sharpness: float | None = None,
        limit: float = 100.0,
        memory: int = 10_000,
        samples: int = 1_000,
    ) -> None:
        if estimator not in get_args(Estimator):
            raise ValueError(f"estimator must be one of {', '.join(get_args(Estimator))}, got {estimator!r}")
        width = torch.as_tensor(sigma, dtype=torch.float64)
        if not bool(((width > 0) & width.isfinite()).all()):
            raise ValueError(f"sigma must be positive and finite, got {sigma}")
        if sharpness is not None and not 0 < sharpness < math.inf:
            raise ValueError(f"sharpness must be positive and finite, or None, got {sharpness}")
        if not 1 < limit < math.inf:
            raise ValueError(f"limit must be above 1 and finite, got {limit}")
        check_whole(k=k, memory=memory, samples=samples)
        self.estimator, self.sigma, self.k, self.sharpness, self.limit = estimator, sigma, k, sharpness, limit
        self.memory, self.samples = memory, samples
        self.goals: Tensor | None = None
        self._next = 0  # next position to be overwritten once the memory is full
        self._reference: _Reference | None = None

    def __call__(self, goals: Tensor) -> Tensor:
        if self.goals is None or goals.numel() == 0:
            return super().__call__(goals)
        if self._reference is None:
            self._reference = self._look()
        samples, scale, level = self._reference = self._reference.to(goals.device)
        logs = self._log_density(goals.double() / scale, samples)
        sharpness = min(1.0, _SHARPEST / len(scale)) if self.sharpness is None else self.sharpness
        bound = math.log(self.limit)
        return normalized_weights(((level - logs) * sharpness).clamp(-bound, bound), goals)

    def update(self, goals: Tensor) -> None:
        """Adds goals to the memory; of more goals than ``memory``, an evenly spread part."""
        goals = goals.detach().reshape(-1, goals.shape[-1])
        goals = goals[goals.isfinite().all(-1)]
        new = goals[spread_evenly(len(goals), self.memory, goals.device)]
        if len(new) == 0:
            return
        self._reference = None
        known = new[:0].clone() if self.goals is None else self.goals.to(new.device)
        if known.shape[1] != new.shape[1]:
            raise ValueError(f"goals must have {known.shape[1]} numbers, as earlier ones, got {new.shape[1]}")
        more = min(self.memory - len(known), len(new))
        place = (torch.arange(len(new) - more, device=new.device) + self._next) % self.memory
        known = torch.cat([known, new[:more].to(known.dtype)]) if more else known
        known[place] = new[more:].to(known.dtype)
        self.goals, self._next = known, (self._next + len(place)) % self.memory

    def clear(self) -> None:
        self.goals, self._next, self._reference = None, 0, None

    def state_dict(self) -> dict[str, Any]:
        return {"goals": None if self.goals is None else self.goals.clone(), "next": self._next}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        goals = state["goals"]
        if goals is not None and len(goals) > self.memory:
            raise ValueError(f"the state must have at most memory={self.memory} goals, got {len(goals)}")
        self.goals, self._next, self._reference = (
            None if goals is None else goals.clone(),
            state["next"],
            None,
        )

    def _look(self) -> _Reference:
        """Selects the points that densities are estimated from until the memory changes."""
        assert self.goals is not None
        samples = self.goals[spread_evenly(len(self.goals), self.samples, self.goals.device)].double()
        scale = goal_scale(samples)
        samples = samples / scale
        # Densities of some goals among the others: a goal must not be its own neighbor.
        held_out = torch.arange(len(samples), device=samples.device) % max(2, len(samples) // _LEVEL) == 0
        others = samples if len(samples) == 1 else samples[~held_out]
        return _Reference(samples, scale, float(self._log_density(samples[held_out], others).median()))

    def _log_density(self, goals: Tensor, samples: Tensor) -> Tensor:
        if self.estimator == "kernel":
            return log_kernel_density(goals, samples, self.sigma)
        return log_neighbor_density(goals, samples, min(self.k, len(samples)), least_distance=_LEAST_DISTANCE)


class _Reference(NamedTuple):
    """Goals from which densities are estimated, and the median density."""

    samples: Tensor  # [n, g] of float64, goals divided by their scale
    scale: Tensor  # [g] of float64
    level: float  # the logarithm of the median density

    def to(self, device: torch.device) -> _Reference:
        return _Reference(self.samples.to(device), self.scale.to(device), self.level)
