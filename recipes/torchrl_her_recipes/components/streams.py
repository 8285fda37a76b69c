"""Seeds for the parts of a run, so that no two parts draw the same random numbers."""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum

import torch

from torchrl_her_recipes.components.devices import CPU, make_generators


class Stream(IntEnum):
    """Numbers added to the seeds of the runs, which are below ``2 ** 31``, to make the seeds of a part."""

    EVALUATION = 1 << 32
    PROPOSED_GOALS = 1 << 33
    STAGES = 1 << 34
    GOAL_SPACE = 1 << 40
    DEMONSTRATED_STARTS = (1 << 40) + (1 << 32)


def generators_of(seeds: Sequence[int], stream: Stream) -> list[torch.Generator]:
    """Returns the generators of a part, one for each run, seeded from the run's seed."""
    return make_generators([stream + seed for seed in seeds], CPU)
