"""Random numbers of actors and losses, from a separate generator for each of several runs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import torch
from torch import Tensor


def generator_states(generators: Iterable[torch.Generator | None]) -> list[Tensor | None]:
    """Returns the states of generators; None for torch's own, which a checkpoint does not hold."""
    return [None if generator is None else generator.get_state() for generator in generators]


def set_generator_states(
    generators: Iterable[torch.Generator | None], states: Iterable[Tensor | None]
) -> None:
    """Restores the states that :func:`generator_states` returned, one for each generator."""
    for generator, state in zip(generators, states, strict=True):
        if generator is not None and state is not None:
            generator.set_state(state)


class RunNoise:
    """Standard normal numbers and random subsets for R runs, each from its own generator.

    What a run draws then does not depend on which other runs are trained beside it.

    Args:
        generators: R generators; None for torch's own, which all runs share.

    Attributes:
        generators: generators of the runs. Copies of this object share them.
        idle: runs that draw nothing; their numbers are 0.

    Example:
        >>> alone, beside = torch.Generator().manual_seed(1), torch.Generator().manual_seed(1)
        >>> one = RunNoise([alone])(torch.zeros(3, 2))
        >>> two = RunNoise([torch.Generator(), beside])(torch.zeros(2, 3, 2))
        >>> bool((one == two[1]).all())
        True
    """

    def __init__(self, generators: Sequence[torch.Generator | None] | None = None) -> None:
        self.generators = None if generators is None else list(generators)
        self.idle: Sequence[int] = ()

    def __deepcopy__(self, memo: dict[int, Any]) -> RunNoise:
        return RunNoise(self.generators)

    def __call__(self, like: Tensor) -> Tensor:
        """Draws numbers of the shape, type and device of a tensor whose first dimension is R equal blocks."""
        if self.generators is None:
            return torch.randn_like(like)
        out = torch.empty_like(like, memory_format=torch.contiguous_format)
        blocks = out.view(len(self.generators), -1)
        for run, (block, generator) in enumerate(zip(blocks, self.generators, strict=True)):
            if run in self.idle:
                block.zero_()
            else:
                block.normal_(generator=generator)
        return out

    def subsets(self, count: int, of: int) -> Tensor:
        """Draws distinct whole numbers below ``of`` for each run, [R, count] in ascending order.

        Without generators, all runs share one draw from torch's own, [1, count].

        Example:
            >>> RunNoise([torch.Generator().manual_seed(run) for run in range(3)]).subsets(2, 5).shape
            torch.Size([3, 2])
        """
        sources: Sequence[torch.Generator | None] = self.generators or [None]
        devices = [None if source is None else source.device for source in sources]
        drawn = [
            torch.arange(count, device=device)
            if run in self.idle
            else torch.randperm(of, generator=source, device=device)[:count]
            for run, (source, device) in enumerate(zip(sources, devices, strict=True))
        ]
        return torch.stack(drawn).sort(-1).values
