"""Seeds for the components of a run, so that no two components draw the same random numbers."""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum

import torch

from torchrl_her_recipes.components.devices import CPU, make_generators


class Stream(IntEnum):
    """Offsets that, added to the seed of a run (below ``2 ** 31``), give the seeds of its components."""

    EVALUATION = 1 << 32
    PROPOSED_GOALS = 1 << 33
    STAGES = 1 << 34
    GOAL_SPACE = 1 << 40
    DEMONSTRATED_STARTS = (1 << 40) + (1 << 32)


def generators_of(seeds: Sequence[int], stream: Stream) -> list[torch.Generator]:
    """Returns the random generators of a component, one for each run, seeded by the run's seed."""
    return make_generators([stream + seed for seed in seeds], CPU)
