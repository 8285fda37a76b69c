"""Makes the weights of virtual goals for the choices in :mod:`...config.choices.weights`."""

from __future__ import annotations

from typing import Any

from torchrl_her.goals.ibs import GoalHistogram, Instructiveness
from torchrl_her.goals.instructive import InstructiveWeights
from torchrl_her.goals.kernel_ibs import KernelInstructiveness
from torchrl_her.goals.rare import RareGoals
from torchrl_her.goals.rnd import NetworkNovelty
from torchrl_her_recipes.components.goals.space import MOST_DIMENSIONS, GoalSpace, KernelSpace, goal_width
from torchrl_her_recipes.config.choices.weights import IBS, RND, Equal, Rare, SequentialIBS


def make_counts(options: Equal, *, space: Any, **_: Any) -> GoalHistogram | None:
    """Makes weights that are equal for all goals and count goals; None if the space of goals is unknown."""
    return GoalHistogram(space.grid, recent=options.recent) if space is not None else None


def make_instructive(
    options: SequentialIBS, *, space: GoalSpace | KernelSpace, **_: Any
) -> InstructiveWeights:
    """Makes weights that prefer goals near the task's own goals (IBS)."""
    shared = ("start_factor", "decay", "floor")
    names = shared if isinstance(space, KernelSpace) else (*shared, "floor_is_relative", "recent")
    keywords: dict[str, Any] = {name: value for name, value in vars(options).items() if name in names}
    keywords |= {"sigma": space.sigma, "subtract": isinstance(options, IBS)}
    if isinstance(space, KernelSpace):
        return KernelInstructiveness(space.goals, **keywords)
    return Instructiveness(space.grid, space.target_at, **keywords)


def make_rare(options: Rare, *, env: Any, **_: Any) -> RareGoals:
    """Makes weights that prefer rare goals, by a kernel density or, in many dimensions, by neighbors."""
    return RareGoals(
        estimator="kernel" if goal_width(env) <= MOST_DIMENSIONS else "neighbors",
        sharpness=options.sharpness,
        memory=options.memory,
    )


def make_network_novelty(options: RND, *, seed: int, **_: Any) -> NetworkNovelty:
    """Makes weights that prefer goals that are new to a network (RND), initialized by the run's seed."""
    return NetworkNovelty(seed=seed, sharpness=1.0 if options.sharpness is None else options.sharpness)
