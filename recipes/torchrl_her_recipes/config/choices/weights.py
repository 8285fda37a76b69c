"""Choices of goal weights, with their options; the makers are in :mod:`..components.goals.weights`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from torchrl_her_recipes.config.choices.kind import Choice, Kind
from torchrl_her_recipes.config.options import Needs, option

_MAKERS = "torchrl_her_recipes.components.goals.weights"


@dataclass(frozen=True, kw_only=True)
class Weights(Choice):
    """Which virtual goals are preferred.

    The maker is called once for each run. It takes the options and by keyword ``env``, ``seed`` (of the run)
    and ``space`` (of the task's goals, for subclasses of :class:`Equal`), and returns new
    :class:`~torchrl_her.GoalWeights`.
    """


WEIGHTS = Kind("weights", Weights, default="none")


@dataclass(frozen=True, kw_only=True)
class Equal(Weights):
    """Gives all goals equal weight; counts goals of a known range, for the metric kl."""

    name = "none"
    maker = f"{_MAKERS}:make_counts"

    cells: int = option(20, "cells along each dimension of the grid that goals are counted in", at_least=1)
    recent: int | None = option(
        None, "number of the newest goals that q counts; all since the buffer was emptied if None", at_least=1
    )


@dataclass(frozen=True, kw_only=True)
class SequentialIBS(Equal):
    """Weights q* alone; prioritized replay does the rest."""

    name = "ibs_sequential"
    maker = f"{_MAKERS}:make_instructive"
    needs: ClassVar[Needs] = (("estimator", "kernel".__ne__, "cells recent"),)

    sigma: float | None = option(
        None, "width of the kernel around the real goals, as a share of the range of goals", above=0
    )
    start_factor: float = option(3.0, "sigma begins at this multiple of its final value", at_least=1)
    decay: float = option(0.9, "the kernel's covariance is multiplied by this each epoch", above=0, at_most=1)
    estimator: str = option(
        "auto",
        "what q* and q are: grid (histograms, for goals of up to three numbers), kernel (densities, for any "
        "goals), or auto (kernel for more than three numbers)",
        choices=("auto", "grid", "kernel"),
    )


@dataclass(frozen=True, kw_only=True)
class IBS(SequentialIBS):
    """Instructive goals: weights q* - q."""

    name = "ibs"
    needs = (("estimator", "kernel".__ne__, "floor_is_relative cells recent"),)

    floor: float = option(0.002, "lowest weight of a goal, as a share of the largest q*", at_least=0)
    floor_is_relative: bool = option(
        True, "whether floor is such a share; if false, it is compared with q* - q as it is (the thesis)"
    )


@dataclass(frozen=True, kw_only=True)
class _Novelty(Weights):
    sharpness: float | None = option(
        None,
        "exponent of the weights; the default is 1, and 3 / g for rare goals of g numbers, if g is above 3",
        above=0,
    )


@dataclass(frozen=True, kw_only=True)
class Rare(_Novelty):
    """Goals with few others around them."""

    name = "rare"
    maker = f"{_MAKERS}:make_rare"

    memory: int = option(10_000, "virtual goals among which others are rare, the newest ones", at_least=1)


@dataclass(frozen=True, kw_only=True)
class RND(_Novelty):
    """Goals new to a network (RND)."""

    name = "rnd"
    maker = f"{_MAKERS}:make_network_novelty"


for _choice in (Equal, IBS, SequentialIBS, Rare, RND):
    WEIGHTS.register(_choice)
