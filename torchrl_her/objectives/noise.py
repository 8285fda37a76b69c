"""The random numbers of losses: each of several runs has its own."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


class RunNoise:
    """Standard normal numbers and random subsets for R runs, each from its own generator.

    What a run draws then does not depend on which other runs are trained beside it.

    Args:
        generators: R of them; None for torch's own generator, which all runs share.

    Example:
        >>> alone, beside = torch.Generator().manual_seed(1), torch.Generator().manual_seed(1)
        >>> one = RunNoise([alone])(torch.zeros(3, 2))
        >>> two = RunNoise([torch.Generator(), beside])(torch.zeros(2, 3, 2))
        >>> bool((one == two[1]).all())
        True
    """

    def __init__(self, generators: Sequence[torch.Generator] | None = None) -> None:
        self.generators = None if generators is None else list(generators)

    def __call__(self, like: Tensor) -> Tensor:
        """Numbers of the shape, type and device of a tensor whose first dimension is R equal blocks."""
        if self.generators is None:
            return torch.randn_like(like)
        out = torch.empty_like(like, memory_format=torch.contiguous_format)
        for block, generator in zip(out.view(len(self.generators), -1), self.generators, strict=True):
            block.normal_(generator=generator)
        return out

    def subsets(self, count: int, of: int) -> Tensor:
        """Whole numbers below ``of``, without repetition, drawn for each run: [R, count], in order of size.

        From torch's own generator, all runs share one draw: [1, count].

        Example:
            >>> RunNoise([torch.Generator().manual_seed(run) for run in range(3)]).subsets(2, 5).shape
            torch.Size([3, 2])
        """
        sources: Sequence[torch.Generator | None] = self.generators or [None]
        devices = [None if own is None else own.device for own in sources]  # draws elsewhere are refused
        drawn = [
            torch.randperm(of, generator=own, device=device)[:count]
            for own, device in zip(sources, devices, strict=True)
        ]
        return torch.stack(drawn).sort(-1).values
