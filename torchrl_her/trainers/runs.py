"""Independent runs in stacked networks: clipping the gradients of each, and leaving some unchanged."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import torch
from torch import Tensor, nn

from torchrl_her.trainers.ddpg_functional import norms_of_runs


@contextmanager
def keep_runs(
    loss: nn.Module, optimizer: torch.optim.Optimizer, kept: Sequence[int], *, runs: int
) -> Iterator[None]:
    """Leaves some runs of a stacked loss and its optimizer unchanged by what happens in the ``with`` block.

    What all runs share, such as Adam's count of steps, does change.

    Args:
        loss: each of its tensors is R equal blocks, in the order of the runs.
        optimizer: over its parameters.
        kept: the runs that stay unchanged.
        runs: R.

    Example:
        >>> weight = nn.Linear(1, 2, bias=False)  # as if of two runs
        >>> with keep_runs(weight, torch.optim.Adam(weight.parameters()), [1], runs=2):
        ...     _ = nn.init.zeros_(weight.weight)
        >>> (weight.weight == 0).flatten().tolist()
        [True, False]
    """
    if not kept:
        yield
        return
    before = {block.data_ptr(): block[list(kept)].clone() for block in _blocks(loss, optimizer, runs)}
    try:
        yield
    finally:
        with torch.no_grad():
            for block in _blocks(loss, optimizer, runs):
                # the state of an optimizer is made at its first step, and begins with zeros
                block[list(kept)] = before.get(block.data_ptr(), 0.0)


def _blocks(loss: nn.Module, optimizer: torch.optim.Optimizer, runs: int) -> list[Tensor]:
    """All tensors that are divided among R runs, as [R, n] each."""
    moments = [entry for state in optimizer.state.values() for entry in state.values()]
    entries = [*loss.state_dict().values(), *moments]
    return [entry.view(runs, -1) for entry in entries if entry.ndim > 0 and entry.numel() % runs == 0]


@torch.no_grad()
def clip_by_run(parameters: Sequence[nn.Parameter], max_norm: float, *, runs: int) -> Tensor:
    """Clips the gradient of each run separately.

    Args:
        parameters: of one stacked network; each is R equal blocks, in the order of the runs.
        max_norm: greatest norm of a run's gradient, over all parameters together.
        runs: R.

    Returns:
        [R], the norms before clipping.

    Example:
        >>> weight = nn.Parameter(torch.zeros(2, 1, 1))
        >>> weight.grad = torch.tensor([[[6.0]], [[2.0]]])
        >>> clip_by_run([weight], 3.0, runs=2).tolist()
        [6.0, 2.0]
        >>> weight.grad.flatten().round(decimals=4).tolist()
        [3.0, 2.0]
    """
    blocks = [parameter.grad.view(runs, -1) for parameter in parameters if parameter.grad is not None]
    norms, scale = norms_of_runs(blocks, max_norm)
    for block in blocks:
        block.mul_(scale.unsqueeze(1))
    return norms
