"""Random numbers of several runs, each from a generator of its own."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchrl_her.checks import check_whole

Generators = Sequence[torch.Generator | None]


def uniform(
    counts: Sequence[int],
    width: int,
    generators: Generators,
    *,
    dtype: torch.dtype | None = None,
    device: torch.device | None = None,
) -> Tensor:
    """Draws numbers in [0, 1) for several runs. The numbers of a run do not depend on the other runs.

    Args:
        counts: number of rows of each of R runs; a run without rows draws nothing.
        width: number of random numbers in a row.
        generators: R generators, one for each run; None for torch's own.

    Keyword Args:
        dtype, device: type and device of the numbers.

    Returns:
        The numbers [sum of counts, width], sorted by run.

    Example:
        >>> both = uniform([1, 2], 2, [torch.Generator().manual_seed(seed) for seed in (0, 1)])
        >>> alone = uniform([2], 2, [torch.Generator().manual_seed(1)])
        >>> both.shape, torch.equal(both[1:], alone)
        (torch.Size([3, 2]), True)
    """
    if len(generators) == 1:
        return torch.rand(counts[0], width, generator=generators[0], dtype=dtype, device=device)
    out = torch.empty(sum(counts), width, dtype=dtype, device=device)
    for part, generator in zip(out.split(list(counts)), generators, strict=True):
        if len(part):
            torch.rand(part.shape, generator=generator, out=part)
    return out


class RunDraws:
    """Uniform numbers for transitions, from the generator of each transition's run.

    Args:
        generators: R generators, one for each run.
        run: [n], the run of each transition, ascending; None for one run.

    Example:
        >>> draws = RunDraws([torch.Generator().manual_seed(0)])
        >>> draws.of(torch.tensor([1]))((1, 3), torch.float32, torch.device("cpu")).shape
        torch.Size([1, 3])
    """

    def __init__(self, generators: Generators, run: Tensor | None = None) -> None:
        self.generators, self.run = generators, run

    def of(self, some: Tensor) -> RunDraws:
        """Returns the random numbers for the transitions at the positions ``some``, ascending."""
        return self if self.run is None else RunDraws(self.generators, self.run[some])

    def __call__(self, shape: tuple[int, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
        n, k = shape
        counts = [n] if self.run is None else self.run.bincount(minlength=len(self.generators)).tolist()
        return uniform(counts, k, self.generators, dtype=dtype, device=device)


def check_generators(runs: int, generators: Sequence[torch.Generator] | None) -> list[torch.Generator] | None:
    """Returns the generators of R runs as a list; None for a single run that uses the buffer's generator.

    Raises:
        ValueError: there is no run, or not a generator for each of several runs.
    """
    check_whole(runs=runs)
    if generators is None:
        if runs > 1:
            raise ValueError(f"{runs} runs need {runs} generators, one for each run, got None")
        return None
    if len(generators) != runs:
        raise ValueError(f"{runs} runs need {runs} generators, one for each run, got {len(generators)}")
    return list(generators)
