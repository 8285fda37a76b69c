"""Options of the weights of virtual goals; functions in ``components.goals.weights`` make the weights."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from torchrl_her_recipes.config.choices.kind import Choice, Kind
from torchrl_her_recipes.config.options import Needs, option

_MAKERS = "torchrl_her_recipes.components.goals.weights"


@dataclass(frozen=True, kw_only=True)
class Weights(Choice):
    """Weights by which virtual goals are drawn.

    The maker is called once for each run, and returns new :class:`~torchrl_her.GoalWeights`. It takes the
    options and the keyword arguments ``env``, ``seed`` (the run's seed) and ``space`` (the space of the
    task's goals; only for options that derive from :class:`Equal`, else None).
    """


WEIGHTS = Kind("weights", Weights, default="none")


@dataclass(frozen=True, kw_only=True)
class Equal(Weights):
    """Equal weights; goals of a known range are counted for the metric kl."""

    name = "none"
    maker = f"{_MAKERS}:make_counts"

    cells: int = option(20, "cells along each dimension of the grid that goals are counted in", at_least=1)
    recent: int | None = option(
        None, "number of newest goals that q counts; if None, all since the buffer was emptied", at_least=1
    )


@dataclass(frozen=True, kw_only=True)
class SequentialIBS(Equal):
    """Goals that the task often has: weights q*, not q* - q; for prioritized replay."""

    name = "ibs_sequential"
    maker = f"{_MAKERS}:make_instructive"
    needs: ClassVar[Needs] = (("estimator", "kernel".__ne__, "cells recent"),)

    sigma: float | None = option(
        None, "width of the kernel around the task's goals, as a fraction of the range of goals", above=0
    )
    start_factor: float = option(3.0, "initial sigma, as a multiple of the final sigma", at_least=1)
    decay: float = option(0.9, "factor of the kernel's covariance in each epoch", above=0, at_most=1)
    estimator: str = option(
        "auto",
        "how q* and q are estimated: grid (histograms, for goals of at most 3 coordinates), kernel "
        "(densities, for any goals), or auto (grid for at most 3 coordinates, else kernel)",
        choices=("auto", "grid", "kernel"),
    )


@dataclass(frozen=True, kw_only=True)
class IBS(SequentialIBS):
    """Goals that the task often has (q*) and transitions seldom have (q): weights q* - q."""

    name = "ibs"
    needs = (("estimator", "kernel".__ne__, "floor_is_relative cells recent"),)

    floor: float = option(0.002, "lowest weight of a goal, as a fraction of the largest q*", at_least=0)
    floor_is_relative: bool = option(
        True, "whether floor is a fraction of the largest q*; if false, floor is the lowest weight itself"
    )


@dataclass(frozen=True, kw_only=True)
class _Novelty(Weights):
    sharpness: float | None = option(
        None,
        "exponent of the weights; default: 1, or 3 / g with weights=rare if goals have g > 3 coordinates",
        above=0,
    )


@dataclass(frozen=True, kw_only=True)
class Rare(_Novelty):
    """Goals with few others around them."""

    name = "rare"
    maker = f"{_MAKERS}:make_rare"

    memory: int = option(10_000, "number of newest virtual goals that rarity is judged by", at_least=1)


@dataclass(frozen=True, kw_only=True)
class RND(_Novelty):
    """Goals new to a network (RND)."""

    name = "rnd"
    maker = f"{_MAKERS}:make_network_novelty"


for _choice in (Equal, IBS, SequentialIBS, Rare, RND):
    WEIGHTS.register(_choice)
