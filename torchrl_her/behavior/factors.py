"""Factors that decide which achieved goals are proposed as goals of the next episodes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchrl_her.checks import check_whole
from torchrl_her.goals.density import goal_scale, log_kernel_density, log_neighbor_density

_KERNEL_DIMENSIONS = 3

Values = Callable[[Tensor, Tensor, Sequence[int]], Tensor]


class GoalCandidates(NamedTuple):
    """Candidates for the goals of m episodes that begin, sorted by run: c achieved goals for each episode.

    Attributes:
        goals: [m, c, g], achieved goals.
        reached: [m, c, o], the observations in which these goals were achieved.
        start: [m, o], the first observation of each episode.
        target: [m, g], the task's own goal in each episode.
        counts: the number of these episodes in each of R runs; the sum is m.
        known: R tensors [s, g], a sample of each run's achieved goals; empty for runs without new episodes.
            An empty sequence if no factor needs samples (``GoalFactor.samples``).
    """

    goals: Tensor
    reached: Tensor
    start: Tensor
    target: Tensor
    counts: Sequence[int]
    known: Sequence[Tensor] = ()

    @property
    def run(self) -> Tensor:
        """The index of each episode's run, [m] int64."""
        counts = torch.tensor(list(self.counts), device=self.goals.device)
        return torch.arange(len(counts), device=counts.device).repeat_interleave(counts)


class GoalFactor:
    """Factor of the probability that a goal is proposed. Subclass it for a measure of your own.

    The base class gives all goals the same factor.

    Attributes:
        samples: number of achieved goals that the factor needs in ``GoalCandidates.known``.

    Example:
        >>> class NotTooFar(GoalFactor):
        ...     def __call__(self, candidates):
        ...         return (candidates.goals - candidates.target.unsqueeze(1)).norm(dim=-1) < 1.0
    """

    samples: int = 0

    def __call__(self, candidates: GoalCandidates) -> Tensor:
        """Returns the factor of each candidate goal, [m, c]: numbers of at least 0, or bool."""
        return candidates.goals.new_ones(candidates.goals.shape[:-1])

    def record(self, ended: Tensor, achieved: Tensor) -> None:
        """Records how many episodes with proposed goals have ended, and in how many the goal was achieved.

        Args:
            ended: [R] int64, number of ended episodes of each run.
            achieved: [R] int64, number of these in which the goal was achieved.
        """

    def state_dict(self) -> dict[str, Any]:
        """Returns tensors and plain data that :meth:`load_state_dict` takes."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores the state that :meth:`state_dict` returned."""


class Successes:
    """Success rates of R runs: exponential moving averages over recent episodes.

    Args:
        runs: R, the number of independent runs.

    Keyword Args:
        memory: number of later episodes after which an episode's weight has fallen to 1 / e of its first
            value.

    Attributes:
        rate: [R] float64, the success rate of each run; ``start`` before the first episode.

    Example:
        >>> successes = Successes(1, memory=2.0, start=0.0)
        >>> successes.record(torch.tensor([2]), torch.tensor([1]))
        >>> round(successes.rate.item(), 4)  # (1 - 1 / e) * 1 / 2
        0.3161
    """

    def __init__(self, runs: int, *, memory: float = 100.0, start: float = 0.5) -> None:
        if not 0 < memory < math.inf:
            raise ValueError(f"memory must be positive and finite, got {memory}")
        self.memory = memory
        self.rate = torch.full((runs,), start, dtype=torch.float64)

    def record(self, ended: Tensor, achieved: Tensor) -> None:
        """Adds the number [R] of ended episodes of each run, and the number [R] that achieved their goal."""
        kept = torch.exp(-ended.double() / self.memory)
        self.rate = kept * self.rate.to(kept.device) + (1 - kept) * achieved / ended.clamp(min=1)


class InverseDensity(GoalFactor):
    """Prefers rare goals: the factor is the inverse of a goal's density among the achieved goals.

    MEGA proposes the goal of the least density (Pitis et al., Maximum Entropy Gain Exploration for Long
    Horizon Multi-goal RL, 2020, arXiv 2007.02832). To prefer rare goals as virtual goals, use
    :class:`~torchrl_her.goals.RareGoals`.

    Each coordinate is divided by its standard deviation over the achieved goals. The density is a Gaussian
    kernel estimate for goals of up to three coordinates, and a nearest-neighbor estimate for more.

    Keyword Args:
        samples: number of achieved goals from which the density is estimated.
        sigma: width of the kernel, in standard deviations.
        k: the distance to the k-th nearest goal gives the nearest-neighbor estimate.

    Raises:
        ValueError: an option is not positive.

    Example:
        >>> known = torch.tensor([[0.0], [0.1], [0.2], [5.0]])
        >>> goals = torch.tensor([[[0.1], [5.0]]])
        >>> candidates = GoalCandidates(goals, goals, torch.zeros(1, 1), torch.zeros(1, 1), [1], [known])
        >>> InverseDensity()(candidates).argmax().item()
        1
    """

    def __init__(self, *, samples: int = 250, sigma: float = 0.2, k: int = 10) -> None:
        for name, number in (("samples", samples), ("sigma", sigma), ("k", k)):
            if not 0 < number < math.inf:
                raise ValueError(f"{name} must be positive and finite, got {number}")
        check_whole(samples=samples, k=k)
        self.samples, self.sigma, self.k = samples, sigma, k

    def __call__(self, candidates: GoalCandidates) -> Tensor:
        parts = zip(candidates.goals.split(list(candidates.counts)), candidates.known, strict=True)
        logs = torch.cat([self._log_density(goals, known) for goals, known in parts if len(goals)])
        return (logs.amin(1, keepdim=True) - logs).exp()  # 1 for the rarest goal

    def _log_density(self, goals: Tensor, known: Tensor) -> Tensor:
        scale = goal_scale(known)
        points, samples = goals / scale, known / scale
        if goals.shape[-1] <= _KERNEL_DIMENSIONS:
            return log_kernel_density(points, samples, self.sigma).to(goals)
        return log_neighbor_density(points, samples, min(self.k, len(samples))).to(goals)


class ValueCutoff(GoalFactor):
    """Leaves out goals that the critics consider out of reach: those with a value below a cut-off.

    Each run has its own cut-off, which moves with the success rate of its proposed goals. The cut-off falls
    while this rate is above ``high``, by ``step`` in ``memory`` episodes. It rises while the rate is below
    ``low``, up to its initial value. If all of an episode's candidates are below the cut-off, the one with
    the highest value stays. After Pitis et al., Maximum Entropy Gain Exploration for Long Horizon Multi-goal
    RL, 2020 (arXiv 2007.02832), section 3.3.

    Args:
        values: function that returns values of goals, such as :class:`~torchrl_her.behavior.GoalValues`.

    Keyword Args:
        runs: R, the number of independent runs.
        cutoff: initial and greatest value of the cut-off.
        floor: least value of the cut-off.
        step: how far the cut-off moves in ``memory`` episodes.
        low, high: success rates between which the cut-off does not move.
        memory: episodes over which success is averaged.

    Attributes:
        cutoff: [R] float64, the present cut-off of each run.

    Raises:
        ValueError: 0 <= low <= high <= 1 does not hold, or the floor lies above the cut-off.

    Example:
        >>> values = lambda observation, goals, counts: -goals.abs()  # the nearer to 0 the better
        >>> goals = torch.tensor([[[1.0], [2.0], [9.0]], [[5.0], [4.0], [6.0]]])
        >>> candidates = GoalCandidates(goals, goals, torch.zeros(2, 1), torch.zeros(2, 1), [2])
        >>> ValueCutoff(values, cutoff=-3.0)(candidates).tolist()
        [[True, True, False], [False, True, False]]
    """

    def __init__(
        self,
        values: Values,
        *,
        runs: int = 1,
        cutoff: float = -3.0,
        floor: float = -math.inf,
        step: float = 1.0,
        low: float = 0.3,
        high: float = 0.7,
        memory: float = 100.0,
    ) -> None:
        if not 0 <= low <= high <= 1:
            raise ValueError(f"low and high must be 0 <= low <= high <= 1, got low={low}, high={high}")
        if not floor <= cutoff:
            raise ValueError(f"floor must be at most the cut-off {cutoff}, got {floor}")
        self.values, self.floor, self.first, self.step = values, floor, cutoff, step
        self.low, self.high = low, high
        self.successes = Successes(runs, memory=memory)
        self.cutoff = torch.full((runs,), cutoff, dtype=torch.float64)

    def __call__(self, candidates: GoalCandidates) -> Tensor:
        value = (
            self.values(candidates.start, candidates.goals, candidates.counts).mean(-1).nan_to_num(-math.inf)
        )
        cutoff = self.cutoff.to(value)[candidates.run].unsqueeze(1)
        believed = value >= cutoff
        return believed | (~believed.any(1, keepdim=True) & (value == value.amax(1, keepdim=True)))

    def record(self, ended: Tensor, achieved: Tensor) -> None:
        self.successes.record(ended, achieved)
        rate, moved = self.successes.rate, self.step * ended.double() / self.successes.memory
        direction = (rate < self.low).double() - (rate > self.high).double()
        self.cutoff = (self.cutoff.to(moved.device) + direction * moved).clamp(self.floor, self.first)

    def state_dict(self) -> dict[str, Any]:
        return {"cutoff": self.cutoff, "rate": self.successes.rate}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.cutoff, self.successes.rate = state["cutoff"].clone(), state["rate"].clone()


class DiscoverScore(GoalFactor):
    """Prefers goals that can be achieved, that critics disagree about, and that lead to the task's goal.

    The factor is exp(score / temperature), with the score of Diaz-Bone et al., DISCOVER: Automated Curricula
    for Sparse-Reward RL, 2025 (arXiv 2505.19850):

        score = alpha (V(s0, g) + beta S(s0, g)) + (1 - alpha) (V(s_g, g*) + beta S(s_g, g*))

    V and S are the mean and the standard deviation of the critics' values, s0 is the beginning of the
    episode, s_g what was observed when g was achieved, and g* the goal of the task. Each run's alpha rises
    while the success rate of its proposed goals is below ``target``, so that achievable goals count more, and
    falls otherwise.

    With a single critic S is 0; add :class:`InverseDensity`, which then takes the place of S.

    Args:
        values: function that returns values of goals, such as :class:`~torchrl_her.behavior.GoalValues`.

    Keyword Args:
        runs: R, the number of independent runs.
        beta: how much the critics' disagreement counts.
        alpha: initial value of alpha.
        step: how far alpha moves in ``memory`` episodes if their success rate is off the target by 1.
        target: success rate of proposed goals that alpha steers to.
        temperature: divisor of the score, in the unit of values; the lower, the more the best goal is
            preferred.
        memory: episodes over which success is averaged.

    Attributes:
        alpha: [R] float64, the present alpha of each run.

    Raises:
        ValueError: alpha or target is outside of [0, 1], or the temperature is not positive.

    Example:
        >>> values = lambda observation, goals, counts: -(observation.view(1, -1, 1) - goals).abs()
        >>> goals = torch.tensor([[[1.0], [3.0], [6.0]]])  # from the start 0 to the task's goal 4
        >>> candidates = GoalCandidates(goals, goals, torch.zeros(1, 1), torch.full((1, 1), 4.0), [1])
        >>> DiscoverScore(values, alpha=0.0)(candidates).log().tolist()  # only V(s_g, g*) counts
        [[-2.0, 0.0, -1.0]]
    """

    def __init__(
        self,
        values: Values,
        *,
        runs: int = 1,
        beta: float = 1.0,
        alpha: float = 0.5,
        step: float = 1.0,
        target: float = 0.5,
        temperature: float = 1.0,
        memory: float = 100.0,
    ) -> None:
        for name, number in (("alpha", alpha), ("target", target)):
            if not 0 <= number <= 1:
                raise ValueError(f"{name} must be in [0, 1], got {number}")
        if not 0 < temperature < math.inf:
            raise ValueError(f"temperature must be positive and finite, got {temperature}")
        self.values, self.beta, self.step = values, beta, step
        self.target, self.temperature = target, temperature
        self.successes = Successes(runs, memory=memory, start=target)
        self.alpha = torch.full((runs,), alpha, dtype=torch.float64)

    def __call__(self, candidates: GoalCandidates) -> Tensor:
        near = self._bound(self.values(candidates.start, candidates.goals, candidates.counts))
        far = self._bound(self.values(candidates.reached, candidates.target.unsqueeze(1), candidates.counts))
        alpha = self.alpha.to(near)[candidates.run].unsqueeze(1)
        score = ((alpha * near + (1 - alpha) * far) / self.temperature).nan_to_num(-math.inf)
        return (score - score.amax(1, keepdim=True)).exp().nan_to_num(0.0)

    def record(self, ended: Tensor, achieved: Tensor) -> None:
        self.successes.record(ended, achieved)
        moved = self.step * ended.double() / self.successes.memory * (self.target - self.successes.rate)
        self.alpha = (self.alpha.to(moved.device) + moved).clamp(0.0, 1.0)

    def state_dict(self) -> dict[str, Any]:
        return {"alpha": self.alpha, "rate": self.successes.rate}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.alpha, self.successes.rate = state["alpha"].clone(), state["rate"].clone()

    def _bound(self, values: Tensor) -> Tensor:
        """Returns an optimistic value [m, c] of each goal, from the values [m, c, E] of E critics."""
        return values.mean(-1) + self.beta * values.std(-1, correction=0)
