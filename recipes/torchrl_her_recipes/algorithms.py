"""The algorithms by name: what each does with the episodes that it collects."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Instructive = Literal["simultaneous", "sequential"]


@dataclass(frozen=True, kw_only=True)
class Algorithm:
    """One way to use hindsight on top of a learner.

    Args:
        name: the name that recipes take.
        hindsight: whether virtual rows are written at all.
        filter_achieved: whether virtual goals that were already achieved are left out.
        instructive: how goals are preferred that instruct (IBS): less the more often they were written
            already, or by the target alone; None for all alike.
        curriculum: whether it climbs the layers of the task's curriculum (CHER).
        summary: one line for people.
    """

    name: str
    hindsight: bool = True
    filter_achieved: bool = False
    instructive: Instructive | None = None
    curriculum: bool = False
    summary: str = ""


ALGORITHMS: dict[str, Algorithm] = {
    algorithm.name: algorithm
    for algorithm in (
        Algorithm(name="no_hindsight", hindsight=False, summary="the learner alone"),
        Algorithm(name="her", summary="hindsight experience replay"),
        Algorithm(
            name="filtered_her", filter_achieved=True, summary="HER without goals that were already achieved"
        ),
        Algorithm(
            name="her_ibs", instructive="simultaneous", summary="HER with goals that instruct: weights q* - q"
        ),
        Algorithm(
            name="filtered_her_ibs",
            filter_achieved=True,
            instructive="simultaneous",
            summary="both together",
        ),
        Algorithm(
            name="her_ibs_sequential",
            instructive="sequential",
            summary="HER with weights q* alone, left to prioritised replay",
        ),
        Algorithm(
            name="cher", curriculum=True, filter_achieved=True, summary="filtered HER up a curriculum: CHER"
        ),
        Algorithm(
            name="cher_ibs",
            curriculum=True,
            filter_achieved=True,
            instructive="simultaneous",
            summary="CHER with goals that instruct in the layers that ask for it",
        ),
        Algorithm(name="unfiltered_cher", curriculum=True, summary="CHER without the filter"),
        Algorithm(
            name="unfiltered_cher_ibs",
            curriculum=True,
            instructive="simultaneous",
            summary="CHER with goals that instruct and without the filter",
        ),
    )
}


def get_algorithm(name: str) -> Algorithm:
    """The algorithm of a name.

    Raises:
        ValueError: there is none; the message lists those that there are.

    Example:
        >>> get_algorithm("her").filter_achieved
        False
    """
    if name not in ALGORITHMS:
        raise ValueError(f"unknown algorithm {name!r}; the algorithms are {', '.join(ALGORITHMS)}")
    return ALGORITHMS[name]
